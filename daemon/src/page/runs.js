// The list of recordings.

import { $, ask, duration, el, text, verdict_word } from "./live.js";
import { choose, say } from "./dialogs.js";
import { plot } from "./charts.js";

const SHOWN_MAX = 100;
let runs = [];
let all = false;

export const names = () => new Set(runs.map((run) => run.name));

export async function refresh() {
  try {
    runs = await ask("runs");
  } catch (error) {
    say("bad", error.message);
  }
  show();
}

// With the zone: whoever compares it with a robot's log has to know.
function begun(started_ns) {
  if (started_ns === null) return "time not known";
  return new Date(started_ns / 1e6).toLocaleString(undefined, {
    year: "numeric", month: "2-digit", day: "2-digit", hour: "2-digit", minute: "2-digit", second: "2-digit", timeZoneName: "short",
  });
}

function facts(run) {
  const people = [run.robot, run.bar, run.payload, run.operator].filter(Boolean).join(", ");
  const valid = `${run.cycles_valid} of ${run.cycles} cycles valid`;
  const parts = [begun(run.started), run.cycles ? `${duration(run.length_s)}, ${valid}` : null, people];
  if (run.recovered) parts.push("recovered");
  if (run.simulated) parts.unshift("SIMULATED");
  if (run.replay_of) parts.push(`replay of ${run.replay_of.name}, recorded ${begun(run.replay_of.started)} on ${run.replay_of.bus}`);
  return parts.filter(Boolean).join(" · ");
}

const with_note = (run) => [facts(run), run.note].filter(Boolean).join("\n");

const why = (run) => run.verdict?.reasons.join("; ") || (run.verdict ? "" : run.cause);

async function remove(run) {
  const yes = await choose({
    title: `Delete ${run.name}?`,
    text: `${with_note(run)}\n\n${run.file} is removed from the disk. Nobody can bring it back.`,
    yes: "Delete", danger: true,
  });
  if (!yes) return;
  try {
    await ask("delete", { name: run.name });
    say("good", `${run.name} is deleted`);
  } catch (error) {
    say("bad", error.message);
  }
  refresh();
}

async function note(run) {
  const said = await choose({ title: `Note of ${run.name}`, label: "Note", value: run.note, lines: 5, yes: "Keep" });
  if (said === null) return;
  try {
    await ask("note", { name: run.name, note: said });
  } catch (error) {
    say("bad", error.message);
  }
  refresh();
}

async function look(run) {
  try {
    const curves = await ask(`runs/${encodeURIComponent(run.name)}/plot`);
    text($("plot-title"), run.name);
    text($("plot-text"), `Degrees from the first valid sample of each joint.\n${with_note(run)}\nIt ended: ${run.cause}`);
    $("plot").showModal();
    plot(curves);
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
  const tool = (label, act) => el("button", { type: "button", textContent: label, ariaLabel: `${label} ${run.name}`, onclick: () => act(run) });
  const tools = run.verdict ? [tool("Plot", look), download("MCAP", "mcap"), download("CSV", "csv"),
    download("CSV;", "csv?excel=true", "for Excel: semicolons and decimal commas"), tool("Note", note), tool("Delete", remove)] : [];
  const item = el("li", { level: run.verdict?.level ?? "check" },
    el("span", { className: "verdict", textContent: verdict_word(run.verdict) || "…" }),
    el("span", { className: "name" }, run.name, why(run) ? el("div", { className: "facts", textContent: why(run) }) : null),
    el("span", { className: "facts" }, facts(run), run.note ? el("div", { className: "note", textContent: run.note }) : null),
    el("span", { className: "tools" }, ...tools));
  item.dataset.run = run.name;
  return item;
}

function show() {
  const wanted = $("search").value.toLowerCase().split(/\s+/).filter(Boolean);
  const only = $("only").value;
  const found = runs.filter((run) => {
    const said = `${run.name} ${with_note(run)} ${why(run)} ${verdict_word(run.verdict)}`.toLowerCase();
    return (!only || verdict_word(run.verdict) === only) && wanted.every((word) => said.includes(word));
  });
  const shown = all ? found : found.slice(0, SHOWN_MAX);
  $("runs").replaceChildren(...shown.map(row));
  const more = $("runs-more");
  text(more, runs.length ? (found.length ? "" : "No run is like that.") : "No run is recorded yet.");
  if (shown.length < found.length) {
    more.append(el("button", { type: "button", textContent: `Show all ${found.length}`, onclick: () => { all = true; show(); } }));
  }
}

$("search").addEventListener("input", show);
$("only").addEventListener("change", show);
