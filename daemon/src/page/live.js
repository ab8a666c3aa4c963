// The connection to the service, and functions that all modules of the page use.
//
// A moment is the content of the page at one time. Moments arrive as events from `/api/events`. If the service refuses the
// event stream, the page polls `/api/live` every second instead. Requests are sent with `ask`.

// If no moment arrives for this time, the page is stale.
const SILENT_MS = 1500;
const POLL_MS = 1000;
const RETRY_EVENTS_MS = 15000;

// Smallest observed value of local arrival time minus time of the moment on the clock of the service. The moment with the
// shortest delay determines it. The age of another moment is its additional delay.
let offset_ms = Infinity;
// Local time at which `bound_offset` was last called.
let bounded_ms = -Infinity;
const BOUND_EVERY_MS = 5000;
const OLD_S = 2;
// Largest age of a moment when the service sends it.
const PERIOD_MS = 200;

function age_s(at_ms) {
  const now = performance.now();
  offset_ms = Math.min(offset_ms, now - at_ms);
  const age = (now - at_ms - offset_ms) / 1000;
  if (age > OLD_S && now - bounded_ms > BOUND_EVERY_MS) bound_offset();
  return age;
}

// Corrects the offset after a clock has stopped or the service has restarted. The reply to a request was computed between
// two known local times, which bound the offset from both sides.
async function bound_offset() {
  const asked_ms = bounded_ms = performance.now();
  try {
    const { at_ms } = await (await fetch("/api/live")).json();
    offset_ms = Math.max(asked_ms - PERIOD_MS - at_ms, Math.min(offset_ms, performance.now() - at_ms));
  } catch {
    // `on_silence` handles a service that does not reply.
  }
}

// Receives moments. Calls `on_minute` with the angles of the last minute, `on_moment` with each moment and its age [s], and
// `on_silence` when no moment has arrived for `SILENT_MS`.
export function listen(on_minute, on_moment, on_silence) {
  let silence_timer;
  const receive = (text) => {
    clearTimeout(silence_timer);
    silence_timer = setTimeout(on_silence, SILENT_MS);
    const moment = JSON.parse(text);
    on_moment(moment, age_s(moment.at_ms));
  };
  silence_timer = setTimeout(on_silence, SILENT_MS);
  let polling;
  const poll = async () => {
    try {
      const answer = await fetch("/api/live");
      if (answer.ok) receive(await answer.text());
    } catch {
      // `on_silence` handles a service that does not reply.
    }
  };
  const open = () => {
    bound_offset();
    clearInterval(polling);
    polling = undefined;
    const events = new EventSource("/api/events");
    events.addEventListener("minute", (event) => on_minute(JSON.parse(event.data)));
    events.onmessage = (event) => receive(event.data);
    events.onerror = () => {
      // After a lost connection, the browser reconnects automatically. If the service refused the stream, because too many
      // pages are open, poll until the next attempt.
      if (events.readyState !== EventSource.CLOSED || polling) return;
      polling = setInterval(poll, POLL_MS);
      setTimeout(open, RETRY_EVENTS_MS);
    };
  };
  open();
}

// Sends a request and returns the reply. If the request is refused, throws an error with the problem and its remedy.
export async function ask(path, body) {
  const request = body === undefined
    ? {}
    : { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) };
  let response;
  try {
    response = await fetch(`/api/${path}`, request);
  } catch {
    throw new Error("the service does not answer; check that it is running: ballbard run");
  }
  const reply = await response.json().catch(() => undefined);
  if (!response.ok) throw new Error(reply?.error ?? `the service replied ${response.status}`);
  // The service aborts a reply if it cannot read the recording to its end.
  if (reply === undefined) throw new Error("the reply of the service ended early; its log shows why");
  return reply;
}

export const $ = (id) => document.getElementById(id);

// Creates an element with properties and children. Text is never parsed as HTML.
export function el(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  const { level, ...rest } = properties;
  if (level) element.dataset.level = level;
  Object.assign(element, rest);
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

// Sets the text of an element only if the text has changed, so that screen readers and selections are not disturbed.
export function text(node, content) {
  if (node.textContent !== content) node.textContent = content;
}

export function duration(seconds) {
  const whole = Math.max(0, Math.floor(seconds));
  const two = (n) => String(n).padStart(2, "0");
  const [h, m, s] = [Math.floor(whole / 3600), Math.floor(whole / 60) % 60, whole % 60];
  return h ? `${h}:${two(m)}:${two(s)}` : `${m}:${two(s)}`;
}

// Prefix of the marker that contains the reason why a run was begun although the check found a severe problem.
const IN_SPITE_OF = "begun in spite of";
export const is_reason = (mark) => mark.text.startsWith(IN_SPITE_OF);
export const marked = (mark) => `${duration(mark.at_s)}  ${mark.text}`;

export const verdict_word = (verdict) => (verdict ? verdict.level.toUpperCase() : "");
