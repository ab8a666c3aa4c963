// Questions to the person, and what becomes of them.

import { $, ask, el, text } from "./live.js";

const SAID_MS = 6000;

// Does what somebody asked for; what was said of earlier actions goes.
export function act(path, body) {
  hush();
  return ask(path, body);
}

export const hush = () => $("said").replaceChildren();

// A line below the state, with more buttons than the one that takes it away; what is bad stays until the next action.
export function say(level, said, ...buttons) {
  const line = el("p", { level }, el("span", { textContent: said }), ...buttons);
  line.append(el("button", { type: "button", textContent: "Close", onclick: () => line.remove() }));
  $("said").append(line);
  if (level !== "bad") setTimeout(() => line.remove(), SAID_MS);
  while ($("said").children.length > 4) $("said").firstChild.remove();
}

// Enter ends a text of one line, in one of several lines it begins the next; there Ctrl and Enter end it. What is dangerous
// takes its button.
$("ask-input").addEventListener("keydown", (event) => {
  const ends = $("ask-input").rows === 1 || event.ctrlKey || event.metaKey;
  if (event.key !== "Enter" || event.isComposing || !ends) return;
  event.preventDefault();
  if ($("ask-yes").className !== "danger") $("ask-yes").click();
});

// Answers the question that was asked last. The event of its end comes late: the next may have been asked by then.
let finish = () => {};
$("ask").addEventListener("close", () => { if (!$("ask").open) finish(); });

// Asks; gives what was typed (or `true` where there is nothing to type), or null.
export function choose({ title, text: said = "", label, value = "", lines = 1, required = false, yes, danger = false }) {
  finish();
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
  hush();
  dialog.showModal();
  // Enter at once does no harm.
  (label ? input : $("ask-no")).focus();
  return new Promise((resolve) => {
    finish = () => {
      finish = () => {};
      resolve(dialog.returnValue === "yes" ? (label ? input.value.trim() : true) : null);
    };
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
  // Begun on this page: its dialog opens by itself. Elsewhere a button opens it.
  is_mine = false;
  // Why it was not stopped as somebody asked.
  refused = "";

  constructor() {
    $("home").addEventListener("click", () => this.begin());
    $("homing-show").addEventListener("click", () => this.open());
    $("homing-stop").addEventListener("click", () => this.stop());
    $("homing-close").addEventListener("click", () => $("homing").close());
  }

  async begin() {
    const yes = await choose({
      title: "Home encoders",
      text: "Turn one joint after the other, alone, slowly and in its positive direction over its reference mark. It takes "
        + "two minutes at most for each joint.",
      yes: "Begin",
    });
    if (!yes) return;
    this.is_mine = true;
    try {
      await act("home", {});
    } catch (error) {
      this.is_mine = false;
      say("bad", error.message);
    }
  }

  open() {
    this.refused = "";
    $("homing").showModal();
    $("homing-close").focus();
  }

  // For everybody: whoever looks on has to mean it.
  async stop() {
    const yes = await choose({
      title: "Stop the homing?", text: "It ends for whoever turns the joints, and no reference mark is kept.", yes: "Stop homing",
      danger: true,
    });
    if (!yes || this.was_over) return;
    // What is said elsewhere lies under the dialog.
    await act("stop", { cause: "stopped on the page" }).catch((error) => { this.refused = error.message; });
  }

  over() {
    this.was_over = true;
    text($("homing-close"), "Close");
    $("homing-stop").hidden = true;
  }

  // Nobody is kept in the dialog, or asked to turn a joint, by a service that knows nothing of it.
  lose(why) {
    if (!$("homing").open) return;
    this.over();
    $("homing-now").hidden = true;
    text($("homing-error"), why);
  }

  silent() {
    $("homing-show").hidden = true;
    this.lose(UNKNOWN);
  }

  show({ state, homing }, joints) {
    const goes_on = state === "homing";
    const dialog = $("homing");
    if (goes_on && this.is_mine) {
      // Once: whoever closes it is not shown it again.
      this.is_mine = false;
      if (!dialog.open) this.open();
    }
    $("homing-show").hidden = !goes_on || dialog.open;
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
    if (homing.is_over) {
      this.over();
    } else {
      text($("homing-close"), "Close here");
      $("homing-stop").hidden = false;
    }
  }
}

// A code for the camera of a phone, which then needs no token typed.
$("pair").addEventListener("click", async () => {
  try {
    const { links, valid_s, fingerprint } = await act("pair", {});
    text($("pairing-minutes"), `${Math.round(valid_s / 60)}`);
    text($("pairing-fingerprint"), fingerprint ?? "that of the reverse proxy");
    $("pairing-codes").replaceChildren(...links.map(({ address, svg }) => el("li", {},
      el("img", { src: `data:image/svg+xml,${encodeURIComponent(svg)}`, alt: `Code for ${address}` }),
      el("p", { textContent: address }))));
    $("pairing").showModal();
  } catch (error) {
    say("bad", error.message);
  }
});
$("pairing").addEventListener("close", () => $("pairing-codes").replaceChildren());
