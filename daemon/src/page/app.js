// The main module of the page. It shows each moment, which is the content of the page at one time (`Live` in
// control/live.rs), and the lines of the pre-flight check. It sends the requests of the user to the service.
//
// Sections: display of a moment, controls before a run, controls during a run.

import { $, ask, duration, el, listen, marked, text, verdict_word } from "./live.js";
import { Strip, cover } from "./charts.js";
import { Homing, act, choose, hush, say } from "./dialogs.js";
import { refresh } from "./runs.js";

const CHECK_EVERY_MS = 3000;
const NAME_AFTER_MS = 300;
// If the newest values are older than this, the page shows their age [s].
const OLD_S = 1.5;
const AGE_EVERY_MS = 500;
const FIELDS = ["robot", "operator", "bar", "payload", "note"];
const strip = new Strip();
const homing = new Homing();
const form = $("run-form");
// The latest moment; undefined while the service does not answer.
let latest;
let checks = [];
// Identifies the state of the runs when the list of recordings was last loaded. The list is loaded again when it changes.
let shown_list;

// ---- display

function joint_card(joint) {
  const card = el("article", { className: "joint", id: `joint${joint.joint}` },
    el("h2", { id: `joint${joint.joint}-name` }, `Joint ${joint.joint} `, el("span", { textContent: joint.name })),
    el("div", { className: "angle" }),
    el("div", { className: "speed figure" }),
    el("div", { className: "lights" }, el("span", { className: "light health" }), el("span", { className: "light moved" })),
    el("div", { className: "from" }));
  card.setAttribute("aria-labelledby", `joint${joint.joint}-name`);
  return card;
}

function show_joints(joints) {
  const place = $("encoders");
  const homed = joints.filter((joint) => joint.from_mark).length;
  const zero = homed === joints.length ? "reference marks" : homed ? "reference marks or first samples" : "first samples";
  text($("strip-title"), `Last minute, degrees from ${zero}`);
  if (place.children.length !== joints.length) place.replaceChildren(...joints.map(joint_card));
  joints.forEach((joint, index) => {
    const card = place.children[index];
    const [, angle, speed, lights, from] = card.children;
    card.dataset.level = joint.level;
    const degrees = joint.angle_deg;
    // A stale value is not shown, because it could be mistaken for the present value.
    text(angle, degrees === null ? "stale" : `${degrees.toFixed(2).replace("-", "−")}°`);
    const per_s = joint.speed_deg_per_s;
    text(speed, per_s === null ? "– °/s" : `${per_s >= 0 ? "+" : "−"}${Math.abs(per_s).toFixed(1)} °/s`);
    text(from, joint.from_mark ? "0° is its reference mark" : "0° is its first position");
    const [health, moved] = lights.children;
    health.className = `light health ${joint.level === "good" ? "on" : "off"}`;
    text(health, joint.problem ?? "signal good");
    moved.className = `light moved ${joint.has_moved ? "on" : ""}`;
    text(moved, joint.has_moved ? `turned by ${Math.floor(joint.range_deg)}°` : "not moved yet");
  });
}

// Whether a run was active at the previous moment; undefined before the first moment.
let was_running;

function show_state({ headline, status, run_s }) {
  const header = $("state");
  header.dataset.level = headline.level;
  header.dataset.state = status.state;
  $("simulated").hidden = !status.simulated;
  text($("word"), headline.word);
  const codes = status.problems.length ? ` [${[...new Set(status.problems.map((one) => one.code))].join(", ")}]` : "";
  const usual = status.run ? "" : `bus ${status.bus}: ${status.devices.length} devices`;
  text($("reason"), status.reason === null ? usual : status.reason + codes);
  const running = Boolean(status.run);
  document.title = `${headline.word}${running ? ` ${status.run.name}` : ""}${status.simulated ? " (SIMULATED)" : ""} – ballbard`;
  $("run-facts").hidden = !running;
  $("mark").hidden = $("note").hidden = $("stop").hidden = !running || status.state === "closing";
  text($("version"), status.version);
  const focused = document.activeElement;
  const lost_focus = was_running !== undefined && was_running !== running
    && (focused === document.body || ["start", "preflight", "progress", "state"].some((id) => $(id).contains(focused)));
  $("start").hidden = $("preflight").hidden = running;
  $("progress").hidden = !running;
  // The focused element has just been hidden. Move the focus to the run, or to its result.
  if (lost_focus) $(running ? "progress-title" : "runs-title").focus({ preventScroll: true });
  was_running = running;
  if (!running) return;
  text($("run-name"), status.run.name);
  const until = status.run.duration_s === null ? "" : ` of ${duration(status.run.duration_s)}`;
  text($("run-time"), `${duration(run_s ?? 0)}${until}`);
  text($("run-disk"), `${status.run.cycles}`);
}

function counter(label, value, level) {
  return el("div", { level }, el("dt", { textContent: label }), el("dd", { textContent: value }));
}

function show_progress({ status: { run }, verdict, disk_hours }) {
  if (!run) return;
  const flagged = run.cycles - run.cycles_valid;
  const us = (ns) => `${(ns / 1000).toFixed(0)} µs`;
  const late = run.timing?.lateness;
  $("so-far").dataset.level = verdict?.level ?? "good";
  $("so-far").replaceChildren(
    el("span", { className: "verdict", textContent: verdict ? `${verdict_word(verdict)} so far` : "nothing on disk yet" }),
    verdict?.reasons.length ? `: ${verdict.reasons.join("; ")}` : "");
  $("counters").replaceChildren(
    counter("cycles due", `${run.cycles_taken}`),
    counter("on disk", `${run.cycles}`),
    counter("flagged", `${flagged}`),
    counter("lost", `${run.cycles_lost}`),
    counter("not on disk yet", `${run.unsynced_s.toFixed(1)} s`),
    counter("file", `${(run.bytes / 1e6).toFixed(1)} MB`),
    counter("disk left", hours(disk_hours)));
  $("timing").replaceChildren(
    counter("lateness, 99 % below", late ? us(late.p99_ns) : "–"),
    counter("largest lateness", late ? us(late.max_ns) : "–"));
  const marks = run.marks.map(marked);
  if ($("marks").dataset.said !== marks.join("\n")) {
    $("marks").dataset.said = marks.join("\n");
    $("marks").replaceChildren(...marks.map((mark) => el("li", { textContent: mark })));
  }
  text($("file"), run.file);
}

const hours = (left) => (left === null ? "–" : left < 100 ? `${left.toFixed(1)} h` : `${Math.round(left)} h`);

function show_warnings(warnings) {
  const list = $("warnings").firstElementChild;
  const said = warnings.map((warning) => `${warning.text}|${warning.remedy}`).join("\n");
  if (list.dataset.said === said) return;
  list.dataset.said = said;
  $("warnings").hidden = !warnings.length;
  list.replaceChildren(...warnings.map((warning) => {
    const line = el("li", {}, el("b", { textContent: warning.text }), `${warning.remedy} [${warning.code}]`);
    line.dataset.code = warning.code;
    return line;
  }));
}

// Time of the moment whose coverage was drawn last, on the clock of the service [ms].
let cover_ms = 0;
// Time at which the latest moment arrived [ms], and the age of its values at that time [s].
let arrived_ms = performance.now();
let age_on_arrival_s = 0;

function show_age() {
  const age_s = age_on_arrival_s + (performance.now() - arrived_ms) / 1000;
  $("age").hidden = age_s < OLD_S;
  text($("age"), `The newest values are ${age_s < 10 ? age_s.toFixed(1) : Math.round(age_s)} s old.`);
}

function show(moment, age_s) {
  latest = moment;
  arrived_ms = performance.now();
  age_on_arrival_s = age_s + Math.max(0, moment.status.sample_age_ms ?? 0) / 1000;
  show_age();
  document.body.classList.remove("stale");
  show_state(moment);
  show_joints(moment.joints);
  show_progress(moment);
  show_warnings(moment.warnings);
  homing.show(moment.status, moment.joints);
  strip.add(moment);
  if (moment.at_ms - cover_ms > 500 || moment.at_ms < cover_ms) {
    cover_ms = moment.at_ms;
    text($("cover-text"), cover(moment.coverage, moment.restarted));
  }
  show_begin();
  // This text changes when the file of a run has been created and when a run is over.
  const listed = `${moment.status.runs_over} ${moment.status.run?.file}`;
  if (shown_list !== listed) {
    shown_list = listed;
    refresh(moment.status.run ? null : moment.status.last);
    show_name();
  }
}

function silent() {
  latest = undefined;
  const header = $("state");
  header.dataset.level = "bad";
  header.dataset.state = "";
  text($("word"), "NO CONNECTION");
  text($("reason"), "The service does not answer, so its state is unknown. Check that it is running (ballbard run).");
  document.title = "NO CONNECTION – ballbard";
  document.body.classList.add("stale");
  for (const card of $("encoders").children) {
    delete card.dataset.level;
    text(card.children[1], "stale");
    text(card.children[2], "– °/s");
    for (const light of card.querySelectorAll(".light")) {
      light.classList.remove("on", "off");
      text(light, "unknown");
    }
  }
  delete $("so-far").dataset.level;
  text($("so-far"), "Unknown. The latest known values:");
  text($("cover-text"), "");
  homing.silent();
  $("mark").hidden = $("note").hidden = $("stop").hidden = true;
  show_begin();
}

// ---- before a run

function check_line({ subject, finding, remedy, stops, problems }) {
  const level = remedy ? (stops ? "bad" : "check") : "good";
  const word = { good: "✓", check: "!", bad: "✗" }[level];
  const line = el("li", { level }, el("b", { textContent: `${word} ${subject}: ` }), el("small", { textContent: finding }));
  const codes = [...new Set(problems.map((one) => one.code))].join(", ");
  if (remedy) line.append(el("div", { className: "remedy", textContent: `${remedy} [${codes}]` }));
  line.dataset.subject = subject;
  return line;
}

async function check() {
  if (document.hidden || !latest || latest.status.run) return;
  try {
    checks = await ask("check");
  } catch {
    return;
  }
  // Show problems first.
  const rank = (line) => (line.stops ? 0 : line.remedy ? 1 : 2);
  const sorted = [...checks].sort((one, other) => rank(one) - rank(other));
  const said = JSON.stringify(sorted);
  if ($("checks").dataset.said !== said) {
    $("checks").dataset.said = said;
    $("checks").replaceChildren(...sorted.map(check_line));
  }
  show_begin();
}

const stopping_lines = () => checks.filter((line) => line.stops);

function show_begin() {
  const state = latest?.status.state;
  const stopping = stopping_lines();
  const button = $("begin");
  const is_final = stopping.some((line) => !line.reason_suffices);
  button.disabled = state !== "waiting" || !checks.length || is_final;
  button.classList.toggle("reluctant", stopping.length > 0);
  text(button, stopping.length && !is_final ? "Start anyway …" : "Start");
  const why = state === undefined ? "no connection" : state !== "waiting" ? latest.headline.word.toLowerCase()
    : stopping.length ? `correct first: ${stopping.map((line) => line.subject).join(", ")}` : "";
  text($("begin-why"), why);
  $("home").disabled = state !== "waiting";
}

// Shows the name that the run would get. The service derives the name, so that page and commands use the same rule. Returns
// the problem of the name, or null if the name can be used; undefined if that could not be determined.
async function show_name() {
  const value = (field) => form.elements[field].value.trim();
  const typed = value("name");
  let reply;
  try {
    reply = await ask("name", { name: typed, robot: value("robot"), bar: value("bar") });
  } catch {
    return undefined;
  }
  // The user has changed the text during the request, so this reply is outdated.
  if (value("name") !== typed) return undefined;
  const { name, problem } = reply;
  if (!typed) form.elements.name.placeholder = name;
  form.elements.name.setAttribute("aria-invalid", String(Boolean(problem)));
  text($("name-hint"), problem ?? (typed && name !== typed ? `is saved as ${name}` : ""));
  return problem;
}

let naming;
for (const field of ["name", "robot", "bar"]) {
  form.elements[field].addEventListener("input", () => {
    clearTimeout(naming);
    naming = setTimeout(show_name, NAME_AFTER_MS);
  });
}

// Pressing Enter in a field does not begin a run. Only the button begins a run.
form.addEventListener("submit", (event) => event.preventDefault());

$("begin").addEventListener("click", async () => {
  hush();
  if (!form.reportValidity()) return;
  const request = {};
  for (const field of FIELDS) request[field] = form.elements[field].value.trim();
  const name = form.elements.name.value.trim();
  if (name) request.name = name;
  const minutes = form.elements.minutes.valueAsNumber;
  if (!Number.isNaN(minutes)) request.duration_s = 60 * minutes;
  if (name && await show_name()) {
    form.elements.name.focus();
    return;
  }
  const stopping = stopping_lines();
  if (stopping.length) {
    const reason = await choose({
      title: "Start anyway?",
      text: stopping.map((line) => `${line.subject}: ${line.finding}\n${line.remedy}`).join("\n\n"),
      label: "Reason, stored in the file", required: true, yes: "Start", danger: true,
    });
    if (!reason) return;
    request.reason = reason;
  }
  for (const field of FIELDS) localStorage.setItem(`ballbard.${field}`, request[field]);
  $("begin").disabled = true;
  try {
    const reply = await act("start", request);
    form.elements.name.value = form.elements.minutes.value = "";
    text($("name-hint"), "");
    if (reply.answer === "running") say("check", `run ${reply.run} is active already`);
  } catch (error) {
    if (!await show_name()) say("bad", error.message);
    refresh();
  }
});

for (const field of FIELDS) form.elements[field].value = localStorage.getItem(`ballbard.${field}`) ?? "";

// ---- during a run

// Sends a marker for the time `since_ms`. If `said` is undefined, the service numbers the marker instead.
async function put_mark(said, since_ms) {
  const ago_ms = Math.min(600000, Math.round(performance.now() - since_ms));
  try {
    const reply = await act("mark", { text: said, ago_ms });
    say("good", `marked in run ${reply.run}: ${reply.mark}`);
  } catch (error) {
    say("bad", error.message);
  }
}

const can_mark = () => Boolean(latest?.status.run) && !$("mark").hidden;

// Sets a marker without a text, because the event would be over before a text is typed.
function mark() {
  if (can_mark()) put_mark(undefined, performance.now());
}

// Returns whether a dialog still applies to the run for which it was opened. While it was open, the run may have ended, and
// another client may have begun another run.
function applies_to(run) {
  if (!latest || latest.status.run?.name === run.name) return true;
  say("check", `${run.name} is over, so nothing was changed`);
  return false;
}

// Sets a marker with a text. The time of the marker is the time before the text was typed.
async function note() {
  if (!can_mark()) return;
  const { run } = latest.status;
  const since_ms = performance.now();
  const said = await choose({ title: "Note at this moment", label: "Text", required: true, yes: "Put into the run" });
  if (said && applies_to(run)) put_mark(said, since_ms);
}

async function stop() {
  const run = latest?.status.run;
  if (!run) return;
  const yes = await choose({
    title: `Stop ${run.name}?`, text: `After ${duration(latest.run_s ?? 0)}; its file will be finished.`, yes: "Stop the run", danger: true,
  });
  if (!yes || !applies_to(run)) return;
  try {
    await act("stop", { cause: "stopped on the page" });
  } catch (error) {
    say("bad", error.message);
  }
  refresh();
}

$("mark").addEventListener("click", mark);
$("note").addEventListener("click", note);
$("stop").addEventListener("click", stop);
document.addEventListener("keydown", (event) => {
  const typing = event.target.closest("input, select, textarea, dialog");
  if (typing || event.repeat || event.ctrlKey || event.metaKey || event.altKey) return;
  // The keys also work with Shift or Caps Lock.
  const key = event.key.toLowerCase();
  if (key === "m" || key === "n") {
    event.preventDefault();
    (key === "m" ? mark : note)();
  } else if (event.key === "/") {
    event.preventDefault();
    $("search").focus();
  }
});

listen((minute) => strip.recall(minute), show, silent);
setInterval(show_age, AGE_EVERY_MS);
setInterval(check, CHECK_EVERY_MS);
setTimeout(check, 400);
