// The page's words: a JSON file for each language, chosen by the browser's language, or by the switch.

const KEPT = "trirail language";
const ATTRIBUTES = { sayLabel: "aria-label", sayTitle: "title", sayPlaceholder: "placeholder" };
let words = {};
let language; // that is shown
let wanted; // that was chosen last
const formats = new Map();
const listeners = [];

// What stands for a key, with values in it; for a key that there is not, `otherwise`.
export function say(key, values = {}, otherwise = key) {
  return (words[key] ?? otherwise).replace(/\{(\w+)\}/g, (_, name) => values[name] ?? "");
}

// Whether the language has words of its own for a key.
export const has = (key) => key in words;

// A number with the decimal mark of the language, with `digits` decimals, or as many as it needs up to `most`.
export function number(value, digits = 0, most = digits) {
  const key = `${digits} ${most}`;
  if (!formats.has(key))
    formats.set(key, new Intl.NumberFormat(language, { minimumFractionDigits: digits, maximumFractionDigits: most, useGrouping: false, signDisplay: "negative" }));
  return formats.get(key).format(value).replace("-", "−");
}

// The decimal mark of the language.
export const mark = () => number(0.5, 1)[1];

const clock = () => (language === "en" ? "en-GB" : language); // 24 hours
export const time = (seconds) => new Date(seconds * 1e3).toLocaleTimeString(clock(), { hour12: false });
export const date = (seconds) => new Date(seconds * 1e3).toLocaleString(clock(), { hour12: false });

// Call it whenever the language has changed.
export function onLanguage(listener) {
  listeners.push(listener);
}

// What the robot says, in its own words, beside the page's.
export function quoted(text) {
  const span = document.createElement("span");
  span.translate = false;
  span.textContent = text;
  return span;
}

async function fetched(name) {
  try {
    return await (await fetch(name)).json();
  } catch {
    return {}; // the page works, and STOP with it
  }
}

// Where the browser keeps the choice; null where it keeps nothing for this page, and refuses the question.
function stored() {
  try {
    return localStorage;
  } catch {
    return null; // the page works, and STOP with it
  }
}

// Show the page in a language. Of two that are chosen quickly, the one chosen last stays, whichever arrives last.
async function show(code) {
  wanted = code;
  const arrived = await fetched(`${code}.json`);
  if (code !== wanted || code === language) return;
  words = arrived;
  document.documentElement.lang = language = code;
  formats.clear();
  for (const element of document.querySelectorAll("[data-say]")) element.textContent = say(element.dataset.say);
  for (const [name, attribute] of Object.entries(ATTRIBUTES))
    for (const element of document.querySelectorAll(`[data-${name.replace(/[A-Z]/, (letter) => `-${letter.toLowerCase()}`)}]`))
      element.setAttribute(attribute, say(element.dataset[name]));
  for (const listener of listeners) listener();
}

const languages = await fetched("languages.json");
const wished = [stored()?.getItem(KEPT), ...navigator.languages.map((each) => each.split("-")[0]), "en"];
const chosen = wished.find((each) => each in languages) ?? "en";
const choice = document.getElementById("language");
for (const [code, name] of Object.entries(languages)) choice.add(new Option(name, code, false, code === chosen));
choice.addEventListener("change", () => {
  show(choice.value);
  stored()?.setItem(KEPT, choice.value);
});
await show(chosen);
