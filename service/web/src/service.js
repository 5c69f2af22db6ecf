// The service, asked with the key if there is one. Links and <img> cannot send it, so everything is fetched here.
const KEY = "splatlift-key";
let refused = () => {}; // what to do when a key is wanted

// A link may carry a key after the #, which browsers send nobody: it is taken over, and out of the address bar.
const carried = /^#key=([\w.~+/-]+)$/.exec(location.hash);
if (carried) {
  sessionStorage.setItem(KEY, carried[1]);
  history.replaceState(history.state, "", location.pathname + location.search);
}

addEventListener("hashchange", () => location.hash.startsWith("#key=") && location.reload());

export const keyOf = () => sessionStorage.getItem(KEY);
export const onRefused = action => { refused = action; };

export function useKey(secret) {
  if (secret) sessionStorage.setItem(KEY, secret); else sessionStorage.removeItem(KEY);
  location.reload(); // nothing of what another key showed stays
}

let heard = () => {}; // with whether the service answers
export const onHeard = action => { heard = action; };

const address = path => new URL(path.replace(/^\//, ""), document.baseURI); // also behind a proxy's prefix
const headers = more => (keyOf() ? { ...more, Authorization: `Bearer ${keyOf()}` } : more);

async function problemOf(reply) {
  try {
    return await reply.json();
  } catch {
    return { title: `No answer (${reply.status})`, detail: "try again, or tell the operator", status: reply.status };
  }
}

export async function call(path, { method = "GET", body, signal, more = {} } = {}) {
  const sent = body === undefined ? more : { ...more, "Content-Type": "application/json" };
  let reply;
  try {
    reply = await fetch(address(path), {
      method, signal, headers: headers(sent), body: body === undefined ? undefined : JSON.stringify(body),
    });
  } catch (problem) {
    if (problem.name !== "AbortError") heard(false);
    throw problem;
  }
  heard(true);
  if (reply.ok) return reply;
  const problem = await problemOf(reply);
  if (reply.status === 401) refused();
  throw problem;
}

export const json = async (path, how) => (await call(path, how)).json();
export const post = (path, body, more) => json(path, { method: "POST", body, more });
export const patch = (path, body) => json(path, { method: "PATCH", body });
export const remove = path => call(path, { method: "DELETE" });

// A picture of the service, whole; free its address when nobody shows it any more.
export async function picture(path, body) {
  const image = new Image();
  image.src = URL.createObjectURL(await (await call(path, body && { method: "POST", body })).blob());
  await image.decode();
  return image;
}

// All bytes of an answer, with the progress.
export async function bytes(path, { body, progress = () => {} } = {}) {
  const reply = await call(path, body && { method: "POST", body });
  const total = Number(reply.headers.get("Content-Length")) || 0;
  let whole = new Uint8Array(total || 1 << 20);
  let got = 0;
  for (const reader = reply.body.getReader(); ;) {
    const { done, value } = await reader.read();
    if (done) break;
    if (got + value.length > whole.length) { // compressed on its way: its length is another
      const larger = new Uint8Array(2 * (got + value.length));
      larger.set(whole);
      whole = larger;
    }
    whole.set(value, got);
    got += value.length;
    progress(got, total);
  }
  return whole.subarray(0, got);
}

// An array of NumPy (.npy, version 1): its values as they lie.
export function npy(content) {
  const view = new DataView(content.buffer, content.byteOffset, content.byteLength);
  const start = 10 + view.getUint16(8, true);
  const header = new TextDecoder("latin1").decode(content.subarray(10, start));
  const body = content.slice(start); // a copy begins where a Float32Array may
  return header.includes("<f4") ? new Float32Array(body.buffer) : header.includes("<i4") ? new Int32Array(body.buffer) : body;
}

// Server-sent events by a streaming fetch, which can send the key. Ends with the stream.
export async function* events(path, signal) {
  let last = 0;
  for (let failures = 0; ;) {
    try {
      const reply = await call(path, { signal, more: { "Last-Event-ID": String(last) } });
      if (reply.status === 204) return;
      const reader = reply.body.pipeThrough(new TextDecoderStream()).getReader();
      for (let rest = ""; ;) {
        const { done, value } = await reader.read();
        if (done) break;
        const parts = (rest + value.replaceAll("\r\n", "\n")).split("\n\n");
        rest = parts.pop();
        for (const part of parts) {
          const fields = Object.fromEntries(part.split("\n").filter(line => !line.startsWith(":"))
            .map(line => [line.slice(0, line.indexOf(":")), line.slice(line.indexOf(":") + 1).trim()]));
          if (!fields.event) continue;
          last = fields.id || last;
          failures = 0;
          const data = JSON.parse(fields.data);
          yield { event: fields.event, data };
          if (fields.event === "state" && ["succeeded", "failed", "canceled"].includes(data.state)) return;
        }
      }
    } catch (problem) {
      if (signal.aborted || problem.status || ++failures > 5) throw problem;
    }
    await new Promise(after => setTimeout(after, 1000)); // the line was cut: go on after the last event
  }
}

// A file on its way up: fetch tells of no progress, so this is the older way.
export function upload(kind, file, progress, cameras) {
  const [method, path] = kind === "lift" ? ["POST", `/lifts${cameras ? `?cameras=${cameras}` : ""}`] : ["PUT", `/assets/${kind}`];
  const request = new XMLHttpRequest();
  const done = new Promise((resolve, reject) => {
    request.open(method, address(path));
    for (const [name, value] of Object.entries(headers({}))) request.setRequestHeader(name, value);
    request.upload.onprogress = event => progress(event.loaded, event.total);
    request.onload = () => {
      let answer = { title: `No answer (${request.status})`, detail: "", status: request.status };
      try { answer = JSON.parse(request.responseText); } catch { /* shown as it is */ }
      if (request.status === 401) refused();
      if (request.status < 300) resolve(answer); else reject(answer);
    };
    request.onerror = () => reject({ title: "The upload broke off", detail: "the service closed the connection; try again" });
    request.onabort = () => reject({ title: "Not uploaded", detail: "you ended it", ended: true });
    request.send(file);
  });
  return { done, end: () => request.abort() };
}

// What went wrong, and what to try, in a reader's words: no field of a request, no digest, no address of ours.
export function words(problem) {
  if (problem.expected && problem.got) {
    const hint = problem.hint && !OURS.test(problem.hint) ? ` ${sentence(plainly(problem.hint))}` : "";
    const named = problem.argument && !FIELD.test(problem.argument) ? `${plainly(problem.argument)}: ` : "";
    return plainly(`${problem.title}. ${named}It needs ${problem.expected}, and got ${problem.got}.${hint}`);
  }
  if (problem.title) return plainly(problem.detail ? `${problem.title}: ${problem.detail}` : problem.title);
  return "The service does not answer. Is it running?";
}

const OURS = /\b(GET|PUT|POST|PATCH|DELETE) \/|SPLATLIFT_|\b\w+=[A-Z]|in the (body|query|path) of the request/;
const FIELD = /^(text|like|unlike|negatives|settings|features|labels|words|query|lift|body)(\.|$)/;
const plainly = text => text.replace(/(splats|cameras|features|table|masks|photos|lift) (sha256:)?[0-9a-f]{32,}/g, "the $1")
  .replace(/sha256:[0-9a-f]{8,}/g, "a file").replace(/\b[0-9a-f]{32,}\b/g, "it");

const sentence = text => `${text[0].toUpperCase()}${text.slice(1)}${/[.!?]$/.test(text) ? "" : "."}`;

// What a link leads to, saved under its name.
export async function save(path, fallback, body, ours = false) {
  const reply = await call(path, body && { method: "POST", body });
  const named = /filename="([^"]+)"/.exec(reply.headers.get("Content-Disposition") || "");
  saveBlob(await reply.blob(), named && !ours ? named[1] : fallback);
}

export function saveBlob(blob, name) {
  const anchor = document.createElement("a");
  anchor.href = URL.createObjectURL(blob);
  anchor.download = name;
  anchor.click();
  setTimeout(() => URL.revokeObjectURL(anchor.href), 60000);
}
