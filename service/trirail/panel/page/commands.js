// Commands, override and lease: what may be pressed now, and by whom. What a role may not do is not there.

import { onLanguage, say } from "./words.js";

const SETTING = 1000; // for so long the override's slider is the operator's, then it shows the robot's again [ms]
const POWERED = ["holding", "moving", "stopping"]; // modes in which a motion may begin

const byId = (id) => document.getElementById(id);

export class Commands {
  // `send` says a message to the server; `now()` is the robot and its state, null without contact.
  constructor(send, now, answer) {
    this.now = now;
    this.users = ""; // who is connected
    this.since = null; // since when who holds the lease, as events tell
    this.set = -Infinity; // when the override's slider was last moved by the operator
    for (const button of document.querySelectorAll("[data-command]"))
      button.addEventListener("click", () => {
        const name = button.dataset.command;
        answer(say("answer.asked", { what: say(`do.${name}`) }));
        send(name === "takeover" ? { do: name } : { do: "command", name });
      });
    byId("override").addEventListener("input", (event) => {
      this.set = performance.now();
      showOverride(event.target.value);
    });
    byId("override").addEventListener("change", (event) => send({ do: "override", percent: Number(event.target.value) }));
    onLanguage(() => this.show());
  }

  event({ kind, user, time }) {
    if (kind === "lease") this.since = user ? { user, time } : null;
  }

  // Show what the role may at all.
  roles({ permissions, homes }) {
    for (const element of document.querySelectorAll("[data-needs]")) element.hidden = !permissions.includes(element.dataset.needs);
    for (const button of document.querySelectorAll("[data-command]")) button.hidden = !permissions.includes(button.dataset.command);
    document.querySelector("[data-command=home]").hidden ||= homes.length === 0;
  }

  // Whether each button may be pressed now; what is pressed all the same is refused by the service.
  allow(path) {
    const { robot, state } = this.now();
    const { mode, goal, lease } = state ?? {};
    const running = Boolean(mode) && mode !== "disabled" && mode !== "fault";
    const may = {
      enable: mode === "disabled",
      disable: running,
      home: mode === "holding",
      reset: mode === "fault",
      pause: mode === "moving",
      acquire: Boolean(mode) && !lease,
      takeover: Boolean(mode) && Boolean(lease) && lease !== robot?.user,
      release: Boolean(mode) && Boolean(lease) && lease === robot?.user,
      quick_stop: running,
      resume: Boolean(goal) && (mode === "holding" || mode === "stopping"),
    };
    for (const button of document.querySelectorAll("[data-command]")) button.disabled = !may[button.dataset.command];
    const powered = POWERED.includes(mode) && Boolean(robot?.permissions.includes("goal"));
    for (const button of document.querySelectorAll(".hold, #poses button, #go")) button.disabled = !powered;
    byId("file-start").disabled = byId("follow").disabled = !powered || !path;
    byId("override").disabled = byId("here").disabled = !mode;
    return powered;
  }

  show() {
    const { robot, state } = this.now();
    const known = Boolean(state && robot);
    text(byId("people"), known && this.users ? say("people", { users: this.users }) : "");
    if (!known) return text(byId("lease"), "");
    const { lease, override } = state;
    const since = lease && this.since?.user === lease ? say("lease.since", { time: new Date(this.since.time * 1e3).toLocaleTimeString("en-GB") }) : "";
    const words = lease ? (lease === robot.user ? "lease.mine" : "lease.held") : robot.lease === "required" ? "lease.required" : "lease.nobody";
    text(byId("lease"), say(words, { user: lease, since }));
    const percent = Math.round(override * 100);
    if (performance.now() - this.set > SETTING) showOverride((byId("override").value = percent));
  }
}

function showOverride(percent) {
  text(byId("override-says"), `${percent} %`);
  byId("override").setAttribute("aria-valuetext", `${percent} %`);
}

function text(element, words) {
  if (element.textContent !== words) element.textContent = words;
}
