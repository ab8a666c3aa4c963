// Dialogs of the page (text input, confirmation, homing, pairing), and messages, which are lines below the state.

import { $, ask, el, text } from "./live.js";

const SAID_MS = 6000;

// Sends a request. Removes the messages of earlier requests first.
export function act(path, body) {
  hush();
  return ask(path, body);
}

export const hush = () => $("said").replaceChildren();

// Shows a message with a button that closes it, and with optional other buttons. An error is shown until the next request,
// other messages disappear after a few seconds.
export function say(level, said, ...buttons) {
  const line = el("p", { level }, el("span", { textContent: said }), ...buttons);
  line.append(el("button", { type: "button", textContent: "Close", onclick: () => line.remove() }));
  $("said").append(line);
  if (level !== "bad") setTimeout(() => line.remove(), SAID_MS);
  while ($("said").children.length > 4) $("said").firstChild.remove();
}

// Enter completes a text of one line. In a text of several lines, Enter starts a new line, and Ctrl with Enter completes the
// text. A dangerous action can only be confirmed with its button.
$("ask-input").addEventListener("keydown", (event) => {
  const ends = $("ask-input").rows === 1 || event.ctrlKey || event.metaKey;
  if (event.key !== "Enter" || event.isComposing || !ends) return;
  event.preventDefault();
  if ($("ask-yes").className !== "danger") $("ask-yes").click();
});

// Completes the latest dialog. The browser sends the close event of a dialog late, when the next dialog may already be open.
let finish = () => {};
$("ask").addEventListener("close", () => { if (!$("ask").open) finish(); });

// Opens a dialog. Returns the typed text, or `true` if the dialog has no text field, or null if the user cancels.
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
  // Focus a harmless element, in case the user presses Enter immediately.
  (label ? input : $("ask-no")).focus();
  return new Promise((resolve) => {
    finish = () => {
      finish = () => {};
      resolve(dialog.returnValue === "yes" ? (label ? input.value.trim() : true) : null);
    };
  });
}

// Positive direction of each joint. It is counter-clockwise for an observer towards whom the joint axis points (right-hand
// rule, as in the model of the bar).
const WAYS = {
  1: "Counter-clockwise, seen from above the base.",
  2: "Counter-clockwise, seen against the axis of the fork, so that the rod tilts forward.",
  3: "Counter-clockwise, seen from the flange end along the rod.",
  4: "Counter-clockwise, seen against the axis of the cardan's fork.",
  5: "Counter-clockwise, seen against the axis of the flange side.",
};

const UNKNOWN = "The service does not answer, so the state of the homing is unknown.";
const FORGOTTEN = "The service was restarted, which ended the homing. The line of the reference marks shows whether they were saved.";

export class Homing {
  was_over = true;
  // Whether the homing was begun on this page and its dialog has not been opened yet. For other homings, a button opens the
  // dialog.
  is_mine = false;
  // Why a request to stop the homing was refused.
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
      text: "Turn one joint after the other, alone, slowly and in its positive direction over its reference mark. "
        + "Each joint has a time limit of two minutes.",
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

  // Asks the user for confirmation, because stopping a homing affects every client.
  async stop() {
    const yes = await choose({
      title: "Stop the homing?", text: "It ends for every client, and no reference mark is saved.", yes: "Stop homing",
      danger: true,
    });
    if (!yes || this.was_over) return;
    // Show an error inside the dialog, because the dialog covers the messages.
    await act("stop", { cause: "stopped on the page" }).catch((error) => { this.refused = error.message; });
  }

  over() {
    this.was_over = true;
    text($("homing-close"), "Close");
    $("homing-stop").hidden = true;
  }

  // Removes the instructions and shows `why`, if the state of the homing is unknown or the service has restarted.
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
    const is_active = state === "homing";
    const dialog = $("homing");
    if (is_active && this.is_mine) {
      // Open the dialog only once, so that it stays closed if the user closes it.
      this.is_mine = false;
      if (!dialog.open) this.open();
    }
    $("homing-show").hidden = !is_active || dialog.open;
    if (!dialog.open) return;
    if (!homing) {
      this.lose(FORGOTTEN);
      return;
    }
    this.was_over = homing.is_over;
    const joint = joints.find((one) => one.joint === homing.joint);
    $("homing-now").hidden = !joint;
    if (joint) {
      for (const drawn of document.querySelectorAll(".bar-joint")) {
        drawn.classList.toggle("asked", drawn.id === `bar-joint-${joint.joint}`);
      }
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

// Shows a QR code for the camera of a phone. With this code, the phone opens the page without typing the token.
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
