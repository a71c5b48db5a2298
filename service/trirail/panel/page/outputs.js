// Digital outputs as switches, for who may, and inputs as lamps; on the drawing a tick where an output has switched.

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
  }

  robot({ outputs, inputs }) {
    byId("digital").hidden = outputs.length + inputs.length === 0;
    this.switches = new Map(outputs.map((name) => [name, this.#made("button", name)]));
    this.lamps = new Map(inputs.map((name) => [name, this.#made("span", name)]));
    for (const [name, button] of this.switches) {
      button.disabled = true;
      button.dataset.output = name;
      button.setAttribute("role", "switch");
      button.addEventListener("click", () => {
        this.answer(say("do.set_output"));
        this.send({ do: "command", name: "set_output", content: { output: name, value: button.getAttribute("aria-checked") !== "true" } });
      });
    }
    byId("outputs").replaceChildren(...this.switches.values());
    byId("inputs").replaceChildren(...this.lamps.values());
  }

  state({ outputs, inputs }) {
    for (const [name, button] of this.switches) button.setAttribute("aria-checked", Boolean(outputs[name]));
    for (const [name, lamp] of this.lamps) {
      lamp.className = inputs[name] ? "lamp on" : "lamp";
      lamp.title = say(inputs[name] ? "input.on" : "input.off");
    }
  }

  // Draw where outputs will switch on the path of a goal, and where they have, until another goal has marks.
  event({ kind, goal, marks = [], planned = [] }, drawing) {
    if (kind !== "output" || marks.length + planned.length === 0 || !drawing) return;
    if (goal !== this.goal) drawing.clearTicks();
    this.goal = goal;
    for (const { output, value, pose, number = 1 } of planned) drawing.tick(pose, "planned", label(output, value, number));
    for (const { output, value, commanded } of marks) drawing.tick(commanded, value ? "on" : "off", label(output, value, 1));
  }

  #made(kind, name) {
    const made = document.createElement(kind);
    made.textContent = name;
    made.translate = false;
    return made;
  }
}
