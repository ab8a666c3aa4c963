// Questions to the person, and what becomes of them.

import { $, ask, el, text } from "./live.js";

const SAID_MS = 6000;

// A line at the bottom; what is bad stays until it is taken away.
export function say(level, said) {
  const line = el("p", { level }, el("span", { textContent: said }));
  line.append(el("button", { type: "button", textContent: "Close", onclick: () => line.remove() }));
  $("said").append(line);
  if (level !== "bad") setTimeout(() => line.remove(), SAID_MS);
  while ($("said").children.length > 4) $("said").firstChild.remove();
}

// Enter ends a text of one line, in one of several lines it begins the next; there Ctrl and Enter end it.
$("ask-input").addEventListener("keydown", (event) => {
  if (event.key !== "Enter" || event.isComposing || ($("ask-input").rows > 1 && !event.ctrlKey && !event.metaKey)) return;
  event.preventDefault();
  $("ask-yes").click();
});

// Asks; gives what was typed (or `true` where there is nothing to type), or null.
export function choose({ title, text: said = "", label, value = "", lines = 1, required = false, yes, danger = false }) {
  text($("ask-title"), title);
  text($("ask-text"), said);
  $("ask-label").hidden = !label;
  text($("ask-label").firstElementChild, label ?? "");
  const input = $("ask-input");
  input.value = value;
  input.rows = lines;
  input.required = Boolean(label) && required;
  const button = $("ask-yes");
  text(button, yes);
  button.className = danger ? "danger" : "primary";
  const dialog = $("ask");
  dialog.returnValue = "no";
  dialog.showModal();
  if (label) input.focus();
  return new Promise((resolve) => {
    dialog.addEventListener("close", () => {
      resolve(dialog.returnValue === "yes" ? (label ? input.value.trim() : true) : null);
    }, { once: true });
  });
}

// Positive is counter-clockwise while the axis points at who looks: the right-hand rule of the bar's links.
const WAYS = {
  1: "Counter-clockwise, seen from above the base.",
  2: "Counter-clockwise, seen against the axis of the fork, so that the rod tilts forward.",
  3: "Counter-clockwise, seen from the flange end along the rod.",
  4: "Counter-clockwise, seen against the axis of the cardan's fork.",
  5: "Counter-clockwise, seen against the axis of the flange side.",
};

const UNKNOWN = "The service does not answer: how far the homing is, and whether it goes on, is not known.";
const FORGOTTEN = "The service was started anew: that homing is over. The line of the reference marks says whether they were kept.";

export class Homing {
  was_over = true;
  // Why it was not stopped as somebody asked.
  refused = "";

  constructor() {
    $("home").addEventListener("click", () => this.begin());
    $("homing-stop").addEventListener("click", () => this.stop());
    $("homing").addEventListener("cancel", (event) => { if (!this.was_over) event.preventDefault(); });
  }

  async begin() {
    const yes = await choose({
      title: "Home encoders",
      text: "Turn one joint after the other, alone, slowly and in its positive direction over its reference mark. It takes "
        + "two minutes at most for each joint.",
      yes: "Begin",
    });
    if (!yes) return;
    try {
      await ask("home", {});
    } catch (error) {
      say("bad", error.message);
    }
  }

  async stop() {
    if (this.was_over) {
      $("homing").close();
      return;
    }
    // What is said elsewhere lies under the dialog.
    await ask("stop", { cause: "stopped on the page" }).catch((error) => { this.refused = error.message; });
  }

  // Nobody is kept in the dialog, or asked to turn a joint, by a service that knows nothing of it.
  lose(why) {
    if (!$("homing").open) return;
    this.was_over = true;
    $("homing-now").hidden = true;
    text($("homing-error"), why);
    text($("homing-stop"), "Close");
  }

  silent() {
    this.lose(UNKNOWN);
  }

  show({ state, homing }, joints) {
    const goes_on = state === "homing";
    const dialog = $("homing");
    if (goes_on && !dialog.open) {
      this.refused = "";
      dialog.showModal();
    }
    if (!dialog.open) return;
    if (!homing) {
      this.lose(FORGOTTEN);
      return;
    }
    this.was_over = homing.is_over;
    const joint = joints.find((one) => one.joint === homing.joint);
    $("homing-now").hidden = !joint;
    if (joint) {
      text($("homing-joint"), `Turn joint ${joint.joint}: ${joint.name}`);
      text($("homing-way"), WAYS[joint.joint] ?? "");
      const turned = homing.turned_deg;
      text($("homing-turned"), turned === null ? "found" : `${turned >= 0 ? "+" : "−"}${Math.abs(turned).toFixed(1)}°`);
    }
    const lines = $("homing-lines");
    while (lines.children.length > homing.lines.length) lines.lastChild.remove();
    const are_new = lines.children.length < homing.lines.length;
    while (lines.children.length < homing.lines.length) lines.append(el("li"));
    homing.lines.forEach((line, index) => text(lines.children[index], line));
    if (are_new) lines.scrollTop = lines.scrollHeight;
    text($("homing-error"), homing.error ?? (homing.is_over ? "" : this.refused));
    text($("homing-stop"), homing.is_over ? "Close" : "Stop homing");
  }
}
