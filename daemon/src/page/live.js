// What the service says: moments as they come, and requests.

// Without a moment for so long nothing on the page is live any more.
const SILENT_MS = 1500;
const POLL_MS = 1000;
const RETRY_EVENTS_MS = 15000;

// Calls `on_minute` with the angles of the last minute, `on_moment` with each moment, `on_silence` when none has come for a
// while.
export function listen(on_minute, on_moment, on_silence) {
  let silence;
  const heard = (text) => {
    clearTimeout(silence);
    silence = setTimeout(on_silence, SILENT_MS);
    on_moment(JSON.parse(text));
  };
  silence = setTimeout(on_silence, SILENT_MS);
  let polling;
  const poll = async () => {
    try {
      const answer = await fetch("/api/live");
      if (answer.ok) heard(await answer.text());
    } catch {
      // The silence says it.
    }
  };
  const open = () => {
    clearInterval(polling);
    polling = undefined;
    const events = new EventSource("/api/events");
    events.addEventListener("minute", (event) => on_minute(JSON.parse(event.data)));
    events.onmessage = (event) => heard(event.data);
    events.onerror = () => {
      // It tries again by itself where the service went away; where it was refused a place we ask now and then.
      if (events.readyState !== EventSource.CLOSED || polling) return;
      polling = setInterval(poll, POLL_MS);
      setTimeout(open, RETRY_EVENTS_MS);
    };
  };
  open();
}

// The answer to a request; throws what is wrong and what to do.
export async function ask(path, body) {
  const request = body === undefined
    ? {}
    : { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) };
  let answer;
  try {
    answer = await fetch(`/api/${path}`, request);
  } catch {
    throw new Error("the service does not answer; see whether it runs: ballbard run");
  }
  const said = await answer.json().catch(() => ({ error: `the service answered ${answer.status}` }));
  if (!answer.ok) throw new Error(said.error);
  return said;
}

export const $ = (id) => document.getElementById(id);

// An element with properties and children; text is never taken for HTML.
export function el(tag, properties = {}, ...children) {
  const made = document.createElement(tag);
  const { level, ...rest } = properties;
  if (level) made.dataset.level = level;
  Object.assign(made, rest);
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

// Writes a text only where it changed, so that screen readers and selections are left in peace.
export function text(node, said) {
  if (node.textContent !== said) node.textContent = said;
}

export function duration(seconds) {
  const whole = Math.max(0, Math.floor(seconds));
  const two = (n) => String(n).padStart(2, "0");
  const [h, m, s] = [Math.floor(whole / 3600), Math.floor(whole / 60) % 60, whole % 60];
  return h ? `${h}:${two(m)}:${two(s)}` : `${m}:${two(s)}`;
}

export const verdict_word = (verdict) => (verdict ? verdict.level.toUpperCase() : "");
