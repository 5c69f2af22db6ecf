// Requests to the service, with the key if there is one. Links and <img> cannot send a key, so every request is a fetch.
const KEY = "splatlift-key";
let handleUnauthorized = () => {}; // called for status 401

// A link may have a key after the #, which browsers do not send: it is stored and removed from the address bar.
const linkKey = /^#key=([\w.~+/-]+)$/.exec(location.hash);
if (linkKey) {
  sessionStorage.setItem(KEY, linkKey[1]);
  history.replaceState(history.state, "", location.pathname + location.search);
}

addEventListener("hashchange", () => location.hash.startsWith("#key=") && location.reload());

export const storedKey = () => sessionStorage.getItem(KEY);
export const onUnauthorized = action => { handleUnauthorized = action; };

export function useKey(secret) {
  if (secret) sessionStorage.setItem(KEY, secret); else sessionStorage.removeItem(KEY);
  location.reload(); // data of the other key must not stay
}

let reportAvailability = () => {}; // called with true if the service answers
export const onAvailability = action => { reportAvailability = action; };

const address = path => new URL(path.replace(/^\//, ""), document.baseURI); // also behind a proxy's prefix
const headers = extraHeaders => (storedKey() ? { ...extraHeaders, Authorization: `Bearer ${storedKey()}` } : extraHeaders);

async function problemOf(reply) {
  try {
    return await reply.json();
  } catch {
    return { title: `No answer (${reply.status})`, detail: "try again, or inform the operator", status: reply.status };
  }
}

export async function call(path, { method = "GET", body, signal, extraHeaders = {} } = {}) {
  const allHeaders = body === undefined ? extraHeaders : { ...extraHeaders, "Content-Type": "application/json" };
  let reply;
  try {
    reply = await fetch(address(path), {
      method, signal, headers: headers(allHeaders), body: body === undefined ? undefined : JSON.stringify(body),
    });
  } catch (problem) {
    if (problem.name !== "AbortError") reportAvailability(false);
    throw problem;
  }
  reportAvailability(true);
  if (reply.ok) return reply;
  const problem = await problemOf(reply);
  if (reply.status === 401) handleUnauthorized();
  throw problem;
}

export const fetchJson = async (path, options) => (await call(path, options)).json();
export const post = (path, body, extraHeaders) => fetchJson(path, { method: "POST", body, extraHeaders });
export const patch = (path, body) => fetchJson(path, { method: "PATCH", body });
export const remove = path => call(path, { method: "DELETE" });

// Fetch a picture; the caller revokes its object URL.
export async function fetchPicture(path, body) {
  const image = new Image();
  image.src = URL.createObjectURL(await (await call(path, body && { method: "POST", body })).blob());
  await image.decode();
  return image;
}

// Fetch all bytes of a reply. progress(received): called with their number, as they come.
export async function fetchBytes(path, { body, progress = () => {} } = {}) {
  const reply = await call(path, body && { method: "POST", body });
  const parts = [];
  let received = 0;
  for (const reader = reply.body.getReader(); ;) {
    const { done, value } = await reader.read();
    if (done) break;
    parts.push(value);
    received += value.length;
    progress(received);
  }
  return new Uint8Array(await new Blob(parts).arrayBuffer());
}

// The values of a NumPy array (.npy, version 1) in their order in the file.
export function readNpy(content) {
  const view = new DataView(content.buffer, content.byteOffset, content.byteLength);
  const start = 10 + view.getUint16(8, true);
  const header = new TextDecoder("latin1").decode(content.subarray(10, start));
  const body = content.slice(start); // a copy, aligned for Float32Array
  return header.includes("<f4") ? new Float32Array(body.buffer) : header.includes("<i4") ? new Int32Array(body.buffer) : body;
}

// Server-sent events by a streaming fetch, which can send the key. They end with the stream.
export async function* events(path, signal) {
  let last = 0;
  for (let failures = 0; ;) {
    try {
      const reply = await call(path, { signal, extraHeaders: { "Last-Event-ID": String(last) } });
      if (reply.status === 204) return;
      const reader = reply.body.pipeThrough(new TextDecoderStream()).getReader();
      for (let remainder = ""; ;) {
        const { done, value } = await reader.read();
        if (done) break;
        const parts = (remainder + value.replaceAll("\r\n", "\n")).split("\n\n");
        remainder = parts.pop();
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
    await new Promise(resume => setTimeout(resume, 1000)); // the connection broke: continue after the last event
  }
}

// Upload a file by XMLHttpRequest, as fetch reports no progress.
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
      if (request.status === 401) handleUnauthorized();
      if (request.status < 300) resolve(answer); else reject(answer);
    };
    request.onerror = () => reject({ title: "The upload failed", detail: "the service closed the connection; try again" });
    request.onabort = () => reject({ title: "Not uploaded", detail: "the upload was stopped", ended: true });
    request.send(file);
  });
  return { done, end: () => request.abort() };
}

// The text of an error, in the service's words.
export function problemText(problem) {
  if (!problem.title) return "The service does not answer. Is it running?";
  return [problem.title, problem.detail].filter(Boolean).join(": ");
}

// Save the reply to a request as a file.
export async function download(path, fallback, body, useFallback = false) {
  const reply = await call(path, body && { method: "POST", body });
  const fileName = /filename="([^"]+)"/.exec(reply.headers.get("Content-Disposition") || "");
  downloadBlob(await reply.blob(), fileName && !useFallback ? fileName[1] : fallback);
}

function downloadBlob(blob, name) {
  const anchor = document.createElement("a");
  anchor.href = URL.createObjectURL(blob);
  anchor.download = name;
  anchor.click();
  setTimeout(() => URL.revokeObjectURL(anchor.href), 60000);
}
