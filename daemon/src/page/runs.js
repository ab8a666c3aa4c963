// The list of recordings, the bin, and the result of the run that ended last.

import { $, ask, duration, el, is_reason, marked, text, verdict_word } from "./live.js";
import { act, choose, say } from "./dialogs.js";
import { plot } from "./charts.js";

const SHOWN_MAX = 100;
let runs = [];
let shows_all = false;

// Recordings in the bin.
let deleted = [];
// The run that ended last since the service began; null while another run is active.
let last = null;

// Loads the lists of recordings and of the bin, and shows them. `last_run` is `last` in the status of the service.
export async function refresh(last_run = last) {
  last = last_run;
  try {
    [runs, deleted] = await Promise.all([ask("runs"), ask("bin")]);
  } catch (error) {
    say("bad", error.message);
  }
  show();
  show_bin();
  show_after();
}

// Formats the start of a run with the time zone, so that it can be compared with the log of a robot.
function begun(started_ms) {
  if (started_ms === null) return "time unknown";
  return new Date(started_ms).toLocaleString(undefined, {
    year: "numeric", month: "2-digit", day: "2-digit", hour: "2-digit", minute: "2-digit", second: "2-digit", timeZoneName: "short",
  });
}

function facts(run) {
  const people = [run.robot, run.bar, run.payload, run.operator].filter(Boolean).join(", ");
  const valid = `${run.cycles_valid} of ${run.cycles} cycles valid`;
  const parts = [begun(run.started_ms), run.cycles ? `${duration(run.length_s)}, ${valid}` : null, people];
  if (run.recovered) parts.push("recovered");
  if (run.simulated) parts.unshift("SIMULATED");
  if (run.replay_of) parts.push(`replay of ${run.replay_of.name}, recorded ${begun(run.replay_of.started / 1e6)} on ${run.replay_of.bus}`);
  if (run.verdict && run.cause) parts.push(run.cause);
  return parts.filter(Boolean).join(" · ");
}

const reasons = (run) => run.marks.filter(is_reason).map((mark) => mark.text).join("\n");
const marks = (run) => run.marks.filter((mark) => !is_reason(mark)).map(marked).join(" · ");

const description = (run) => [facts(run), run.note, reasons(run), marks(run)].filter(Boolean).join("\n");

const grade_reasons = (run) => run.verdict?.reasons.join("; ") || (run.verdict ? "" : run.cause);

// Sends a request that changes the list, then loads the list again. Returns the reply, or null if the request was refused.
async function change(path, body) {
  try {
    return await act(path, body);
  } catch (error) {
    say("bad", error.message);
    return null;
  } finally {
    refresh();
  }
}

async function restore(name) {
  const reply = await change("restore", { name });
  if (reply) say("good", `${reply.run} is among the runs again`);
}

async function remove(run) {
  const yes = await choose({
    title: `Delete ${run.name}?`, text: `${description(run)}\n\nIt goes into the bin, from which it can be restored.`, yes: "Delete",
    danger: true,
  });
  const reply = yes && await change("delete", { name: run.name });
  if (!reply) return;
  const undo = el("button", { type: "button", textContent: "Restore", onclick: () => restore(reply.run) });
  say("good", `${run.name} is in the bin`, undo);
}

async function empty_bin() {
  // Another client may have deleted recordings since the list was loaded. It may also do so while the dialog is open.
  await refresh();
  if (!deleted.length) return;
  const names = deleted.map((run) => run.name).join(", ");
  const size_mb = deleted.reduce((sum, run) => sum + run.bytes, 0) / 1e6;
  const yes = await choose({
    title: "Empty the bin?", text: `${names}: ${size_mb.toFixed(1)} MB. They cannot be restored.`, yes: "Remove permanently",
    danger: true,
  });
  if (!yes) return;
  await refresh();
  if (deleted.map((run) => run.name).join(", ") !== names) {
    say("check", "the bin has changed, so nothing was removed; check its content, then empty it again");
    return;
  }
  const reply = await change("bin/empty", {});
  if (reply) say("good", `recordings removed: ${reply.removed}`);
}

async function note(run) {
  const said = await choose({ title: `Note of ${run.name}`, label: "Note", value: run.note, lines: 5, yes: "Save" });
  if (said !== null) await change("note", { name: run.name, note: said });
}

async function show_plot(run) {
  try {
    const curves = await ask(`runs/${encodeURIComponent(run.name)}/plot`);
    text($("plot-title"), run.name);
    text($("plot-text"), `Degrees from the first valid sample of each joint.\n${description(run)}`);
    $("plot").showModal();
    plot(curves, run.marks);
  } catch (error) {
    say("bad", error.message);
  }
}

function row(run) {
  const path = `/api/runs/${encodeURIComponent(run.name)}`;
  const download = (kind, file, layout = "") => el("a", {
    className: "button", href: `${path}/${file}`, download: "", textContent: kind, title: layout,
    ariaLabel: `Download ${run.name} as ${kind} ${layout}`.trim(),
  });
  const tool = (label, action) => el("button", { type: "button", textContent: label, ariaLabel: `${label} ${run.name}`, onclick: () => action(run) });
  const tools = run.verdict ? [tool("Plot", show_plot), download("MCAP", "mcap"), download("CSV", "csv"),
    download("CSV;", "csv?excel=true", "for Excel: semicolons and decimal commas"), tool("Note", note), tool("Delete", remove)] : [];
  tools.at(-1)?.classList.add("apart");
  const item = el("li", { level: run.verdict?.level ?? "check" },
    el("span", { className: "verdict", textContent: verdict_word(run.verdict) || "…" }),
    el("span", { className: "name" }, run.name, grade_reasons(run) ? el("div", { className: "facts", textContent: grade_reasons(run) }) : null),
    el("span", { className: "facts" }, facts(run), run.note ? el("div", { className: "note", textContent: run.note }) : null,
      reasons(run) ? el("div", { className: "reason", textContent: reasons(run) }) : null,
      marks(run) ? el("div", { className: "marks", textContent: marks(run) }) : null),
    el("span", { className: "tools" }, ...tools));
  item.dataset.run = run.name;
  return item;
}

function show() {
  const wanted = $("search").value.toLowerCase().split(/\s+/).filter(Boolean);
  const only = $("only").value;
  const found = runs.filter((run) => {
    const said = `${run.name} ${description(run)} ${grade_reasons(run)} ${verdict_word(run.verdict)}`.toLowerCase();
    return (!only || verdict_word(run.verdict) === only) && wanted.every((word) => said.includes(word));
  });
  const shown = shows_all ? found : found.slice(0, SHOWN_MAX);
  $("runs").replaceChildren(...shown.map(row));
  const more = $("runs-more");
  text(more, runs.length ? (found.length ? "" : "No matching run.") : "No recordings yet.");
  if (shown.length < found.length) {
    more.append(el("button", { type: "button", textContent: `Show all ${found.length}`, onclick: () => { shows_all = true; show(); } }));
  }
}

function show_bin() {
  $("bin").hidden = !deleted.length;
  text($("bin-count"), `${deleted.length}`);
  $("bin-runs").replaceChildren(...deleted.map((run) => el("li", {},
    el("span", { className: "name", textContent: run.name }),
    el("span", { className: "facts", textContent: facts(run) }),
    el("button", { type: "button", textContent: "Restore", ariaLabel: `Restore ${run.name}`, onclick: () => restore(run.name) }))));
}

// Shows the result of the run that has just ended, and the next steps.
function show_after() {
  const run = last?.file ? runs.find((one) => one.file === last.file) : undefined;
  $("after").hidden = !run?.verdict;
  if (!run?.verdict) return;
  $("after").dataset.level = run.verdict.level;
  $("after-title").replaceChildren(`${run.name} is `, el("span", { className: "verdict", textContent: verdict_word(run.verdict) }));
  text($("after-why"), [run.verdict.reasons.join("; "), run.cause].filter(Boolean).join(" · "));
  $("after-next").hidden = !run.next;
  text($("after-log"), `${run.name}.csv`);
  text($("after-command"), run.next ?? "");
  if (document.activeElement === $("runs-title")) $("after-title").focus({ preventScroll: true });
}

$("after-copy").addEventListener("click", async () => {
  try {
    await navigator.clipboard.writeText($("after-command").textContent);
    say("good", "copied");
  } catch {
    say("check", "this browser does not let a page copy; select the text");
  }
});
$("bin-empty").addEventListener("click", empty_bin);
$("search").addEventListener("input", show);
$("only").addEventListener("change", show);
