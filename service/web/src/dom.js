// Elements made of text and elements only: what users named never becomes markup.
export const at = id => document.getElementById(id);

export function el(tag, options = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(options)) {
    if (name === "on") for (const [event, action] of Object.entries(value)) made.addEventListener(event, action);
    else if (name === "style") for (const [property, given] of Object.entries(value)) made.style.setProperty(property, given);
    else if (name === "data") Object.assign(made.dataset, value);
    else if (name in made && typeof made[name] !== "function") made[name] = value;
    else made.setAttribute(name, value);
  }
  made.append(...children.filter(child => child !== null && child !== undefined && child !== false));
  return made;
}

export const count = number => number.toLocaleString("en");
export const plural = (number, one, many = `${one}s`) => `${count(number)} ${number === 1 ? one : many}`;
export const size = bytes => (bytes >= 1e9 ? `${(bytes / 1e9).toFixed(1)} GB` : bytes >= 1e6 ? `${(bytes / 1e6).toFixed(1)} MB`
  : `${Math.max(1, Math.round(bytes / 1e3))} kB`);
export const percent = share => `${share > 0 && share < 0.001 ? "under 0.1" : (100 * share).toFixed(share < 0.1 ? 1 : 0)} %`;

export function ago(seconds) {
  const past = Math.max(0, Date.now() / 1000 - seconds);
  for (const [unit, length] of [["day", 86400], ["hour", 3600], ["minute", 60]]) {
    if (past >= length) return `${plural(Math.floor(past / length), unit)} ago`;
  }
  return "just now";
}

export function fill(select, options, chosen = select.value) {
  select.replaceChildren(...options.map(([value, label]) => new Option(label, value)));
  if (options.some(([value]) => value === chosen)) select.value = chosen;
}

let quiet = 0;

// A short word at the foot of the page, read aloud too.
export function notify(text, bad = false) {
  const toast = at("toast");
  toast.textContent = text;
  toast.classList.toggle("bad", bad);
  toast.hidden = false;
  clearTimeout(quiet);
  quiet = setTimeout(() => { toast.hidden = true; }, bad ? 12000 : 4000);
}

export async function copied(text) {
  try {
    await navigator.clipboard.writeText(text);
    notify("Copied.");
  } catch {
    notify("This browser does not let the page copy: mark the text and copy it by hand.", true);
  }
}

export const still = () => matchMedia("(prefers-reduced-motion: reduce)").matches;

// A button that asks once more before it does what cannot be undone.
export function twice(label, action) {
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
