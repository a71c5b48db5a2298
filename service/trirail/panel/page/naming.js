// Named poses: gone to by a press, taught where the robot stands, forgotten.

import { say } from "./words.js";

const byId = (id) => document.getElementById(id);

export class Naming {
  constructor(send, allow, answer) {
    this.send = send;
    this.allow = allow;
    this.answer = answer;
    this.taught = [];
    byId("pose-name").addEventListener("input", allow);
    byId("teaching").addEventListener("submit", (event) => {
      event.preventDefault();
      this.#do("teach");
    });
    byId("forget").addEventListener("click", () => this.#do("forget"));
  }

  poses({ names, taught }) {
    this.taught = taught;
    byId("poses").replaceChildren(...names.map((name) => this.#button(name)));
    this.allow();
  }

  // Whether its buttons may be pressed, where the robot's state is known or not.
  show(known) {
    const name = byId("pose-name").value.trim();
    byId("teach").disabled = !known || !name;
    byId("forget").disabled = !known || !this.taught.includes(name);
  }

  #button(name) {
    const button = document.createElement("button");
    button.type = "button"; // of a form, but not what sends it
    button.translate = false;
    button.textContent = name;
    button.addEventListener("click", () => {
      this.answer(say("answer.asked", { what: say("do.goto", { name }) }));
      this.send({ do: "goto", name });
    });
    return button;
  }

  #do(what) {
    const name = byId("pose-name").value.trim();
    if (!name) return byId("pose-name").focus();
    this.answer(say("answer.asked", { what: `${say(`do.${what}`)} ${name}` }));
    this.send({ do: what, name });
  }
}
