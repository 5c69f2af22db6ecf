// Elements are made of text and elements alone, so names that users typed never become markup.
export const byId = id => document.getElementById(id);

export function el(tag, options = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(options)) {
    if (name === "on") for (const [event, action] of Object.entries(value)) element.addEventListener(event, action);
    else if (name === "style") for (const [property, setting] of Object.entries(value)) element.style.setProperty(property, setting);
    else if (name === "data") Object.assign(element.dataset, value);
    else if (name in element && typeof element[name] !== "function") element[name] = value;
    else element.setAttribute(name, value);
  }
  element.append(...children.filter(child => child !== null && child !== undefined && child !== false));
  return element;
}

export const formatCount = number => number.toLocaleString("en");
export const plural = (number, noun, pluralNoun = `${noun}s`) => `${formatCount(number)} ${number === 1 ? noun : pluralNoun}`;
export const formatBytes = bytes => (bytes >= 1e9 ? `${(bytes / 1e9).toFixed(1)} GB` : bytes >= 1e6 ? `${(bytes / 1e6).toFixed(1)} MB`
  : `${Math.max(1, Math.round(bytes / 1e3))} kB`);
export const percent = share => `${share > 0 && share < 0.001 ? "under 0.1" : (100 * share).toFixed(share < 0.1 ? 1 : 0)} %`;

export function ago(seconds) {
  const elapsed = Math.max(0, Date.now() / 1000 - seconds);
  for (const [unit, length] of [["day", 86400], ["hour", 3600], ["minute", 60]]) {
    if (elapsed >= length) return `${plural(Math.floor(elapsed / length), unit)} ago`;
  }
  return "just now";
}

export function fillSelect(select, options, selected = select.value) {
  select.replaceChildren(...options.map(([value, label]) => new Option(label, value)));
  if (options.some(([value]) => value === selected)) select.value = selected;
}

let hideTimer = 0;

// Show a short message at the foot of the page; screen readers read it aloud.
export function notify(text, bad = false) {
  const toast = byId("toast");
  toast.textContent = text;
  toast.classList.toggle("bad", bad);
  toast.hidden = false;
  clearTimeout(hideTimer);
  hideTimer = setTimeout(() => { toast.hidden = true; }, bad ? 12000 : 4000);
}

export async function copyText(text) {
  try {
    await navigator.clipboard.writeText(text);
    notify("Copied.");
  } catch {
    notify("This browser does not allow the page to copy. Select the text and copy it by hand.", true);
  }
}

export const prefersStill = () => matchMedia("(prefers-reduced-motion: reduce)").matches;

// A button for an action that cannot be undone: the second click within four seconds runs it.
export function confirmButton(label, action) {
  const button = el("button", { type: "button", className: "danger" }, label);
  button.addEventListener("click", async () => {
    if (!button.dataset.sure) {
      button.dataset.sure = "yes";
      button.textContent = "Really?";
      setTimeout(() => { delete button.dataset.sure; button.textContent = label; }, 4000);
      return;
    }
    try {
      await action();
    } catch (problem) {
      notify(problem.detail || problem.title || String(problem), true);
    }
  });
  return button;
}
