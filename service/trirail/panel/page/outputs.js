// Digital outputs as switches, for who may, and inputs, each with a lamp and a word for its value; on the drawing a tick where an output has switched.

import { say } from "./words.js";

const byId = (id) => document.getElementById(id);

const label = (output, value, number) =>
  `${number > 1 ? `${number} × ` : ""}${output} ${say(value ? "input.on" : "input.off")}`;

export class Outputs {
  // `send` says a message to the server; `answer` shows what was asked.
  constructor(send, answer) {
    this.send = send;
    this.answer = answer;
    this.goal = null; // the goal whose switches are on the drawing
    this.shown = { outputs: new Map(), inputs: new Map() }; // the element of each name
  }

  robot({ outputs, inputs }) {
    byId("digital").hidden = outputs.length + inputs.length === 0;
    this.shown.outputs = new Map(outputs.map((name) => [name, made("button", name)]));
    this.shown.inputs = new Map(inputs.map((name) => [name, made("span", name)]));
    for (const [name, button] of this.shown.outputs) {
      button.disabled = true;
      button.dataset.output = name;
      button.setAttribute("role", "switch");
      const shown = () => button.getAttribute("aria-checked");
      let pressed = null; // the value that was shown when the press began: it may change before the release
      button.addEventListener("pointerdown", () => (pressed = shown()));
      button.addEventListener("click", (event) => {
        const value = event.detail === 0 ? shown() : pressed; // a key, or a screen reader, has no pointer
        pressed = null;
        if (value === null) return; // nobody has seen what the press would change
        this.answer(say("do.set_output"));
        this.send({ do: "command", name: "set_output", content: { output: name, value: value !== "true" } });
      });
    }
    for (const kind of ["outputs", "inputs"]) byId(kind).replaceChildren(...this.shown[kind].values());
    this.lost();
  }

  state(state) {
    for (const [kind, elements] of Object.entries(this.shown)) for (const [name, element] of elements) show(element, state[kind][name]);
  }

  // Nobody knows the values.
  lost() {
    this.state({ outputs: { __proto__: null }, inputs: { __proto__: null } });
  }

  // Draw where outputs will switch on the path of a goal, and where they have, until another goal has marks.
  event({ kind, goal, marks = [], planned = [] }, drawing) {
    if (kind !== "output" || marks.length + planned.length === 0 || !drawing) return;
    if (goal !== this.goal) drawing.clearTicks();
    this.goal = goal;
    for (const { output, value, pose, number = 1 } of planned) drawing.tick(pose, "planned", label(output, value, number));
    for (const { output, value, commanded } of marks) drawing.tick(commanded, value ? "on" : "off", label(output, value, 1));
  }
}

// A lamp, a name and a word for the value.
function made(kind, name) {
  const made = document.createElement(kind);
  made.className = "digital";
  const parts = ["i", "span", "b"].map((part) => document.createElement(part));
  parts[0].className = "lamp";
  parts[1].textContent = name;
  parts[1].translate = false;
  made.append(...parts);
  return made;
}

// Show a value; undefined where it is unknown.
function show(element, value) {
  const word = value === undefined ? "–" : say(value ? "input.on" : "input.off");
  if (element.lastChild.textContent !== word) element.lastChild.textContent = word;
  element.classList.toggle("on", value === true);
  if (value === undefined) element.removeAttribute("aria-checked");
  else if (element.role === "switch") element.setAttribute("aria-checked", value);
}
