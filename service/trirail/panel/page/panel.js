// The operator's page: a WebSocket to the panel's server, buttons that say what is wanted, and what the robot says.

import { Alignment } from "./alignment.js";
import { Charts } from "./charts.js";
import { Drawing } from "./drawing.js";
import { Going } from "./going.js";
import { Hold } from "./hold.js";
import { Readings } from "./readings.js";

const SILENT = 1500; // without a state for so long, what is shown is old [ms]
const SETTING = 1000; // for so long the override's slider is the operator's, then it shows the robot's again [ms]
const AGAIN = 500; // after so long a lost connection is tried again [ms]
const STEPS = [null, 0.01, 0.1, 1, 10]; // what a press of a jog button moves [mm]; null: while it is held
const TURNS = [null, 0.01, 0.1, 1, 1]; // the same about φ [°]
const POWERED = ["holding", "moving", "stopping"]; // modes in which a jog may begin

const LIGHT = matchMedia("(prefers-color-scheme: light)");

const byId = (id) => document.getElementById(id);
const readings = new Readings();
const alignment = new Alignment(byId("alignment"), document.querySelector("[data-view=alignment]"));
export const charts = new Charts();
let socket = null;
let told = null; // the robot, as the server tells of it
let robot = null; // the same in colours that can be read
let drawing = null;
let state = null;
let contact = false; // whether the state is of now
let seen = 0; // the stamp of the newest state that was drawn
let drawn = true;
let heard = 0;
let step = 0; // which of STEPS is chosen
let set = -Infinity; // when the override's slider was last moved by the operator

// ------------------------------------------------------------------ to the server

function send(message) {
  if (socket?.readyState !== WebSocket.OPEN) return readings.answer("not sent: no contact with the panel's server", true);
  socket.send(JSON.stringify(message));
}

const hold = new Hold(
  document.querySelectorAll(".hold"),
  (direction) => {
    if (STEPS[step] !== null) return; // a press is a step: press() sends it
    const [x, y, phi] = robot.velocity;
    const speed = robot.speeds[byId("speed").value];
    send({ do: "hold", velocity: [direction.x * speed * x, direction.y * speed * y, direction.phi * speed * phi], seen });
  },
  () => send({ do: "release" }),
  ({ axis, sign }) => {
    if (STEPS[step] === null) return;
    const by = { x: 0, y: 0, phi: 0, [axis]: Number(sign) * (axis === "phi" ? (TURNS[step] * Math.PI) / 180 : STEPS[step] / 1e3) };
    readings.answer("step …");
    send({ do: "step", by: [by.x, by.y, by.phi], seen });
  },
);

const going = new Going(send, () => drawing, (words) => readings.answer(words));

function stop() {
  hold.end();
  send({ do: "command", name: "stop" });
  readings.answer("stop …");
}

function connect() {
  socket = new WebSocket(new URL("socket", location.href.replace(/^http/, "ws")));
  socket.onmessage = (event) => take(JSON.parse(event.data));
  socket.onclose = () => {
    lost("No contact with the panel's server: is trirail panel still running? STOP here reaches nobody.");
    setTimeout(connect, AGAIN);
  };
}

// ------------------------------------------------------------------ from the server

const takes = {
  robot(said) {
    told = said;
    said = robot = { ...said, colours: { ...said.colours, sliders: said.colours.sliders.map(readable) } };
    drawing = new Drawing(byId("mechanism"), said);
    readings.robot(said);
    charts.robot(said);
    document.querySelector("[data-command=home]").hidden = said.homes.length === 0;
    showSpeed();
    allow();
  },
  state(said) {
    state = said;
    contact = true;
    heard = performance.now();
    if (drawn) requestAnimationFrame(draw); // a hidden page draws nothing, and is sent no more
    drawn = false;
  },
  event({ event }) {
    readings.event(event);
    alignment.event(event);
  },
  silent() {
    lost("No contact with the robot's service: what is shown is old. STOP here reaches nobody.");
  },
  ended({ message }) {
    hold.end();
    readings.answer(message, true);
  },
  refused({ to, message }) {
    readings.answer(`${to}: ${message}`, true);
  },
  done({ to }) {
    readings.answer(`${to}: done`);
  },
  accepted({ to }) {
    readings.answer(`${to}: on its way`);
  },
  poses({ names, taught }) {
    byId("poses").replaceChildren(...names.map(poseButton));
    byId("forget").dataset.taught = JSON.stringify(taught);
    allow();
  },
  checked(said) {
    going.checked(said);
  },
};

function take(said) {
  takes[said.tell](said);
}

function draw() {
  drawn = true;
  seen = state.stamp;
  send({ do: "seen", stamp: seen }); // also where contact was lost meanwhile: without it no more is sent
  if (!contact) return;
  document.body.dataset.contact = "yes";
  drawing.show(state.state);
  going.stands(state.state.pose);
  charts.state(state.state, performance.now());
  readings.state(state.state);
  const percent = Math.round(state.state.override * 100);
  const override = byId("override");
  if (performance.now() - set > SETTING) showOverride((override.value = percent));
  allow();
}

setInterval(() => {
  const old = contact && drawn && !document.hidden && performance.now() - heard > SILENT;
  if (old) lost("Nothing is heard from the panel's server: what is shown is old. STOP here may reach nobody.");
}, 250);

function lost(why) {
  hold.end();
  contact = false;
  document.body.dataset.contact = "none";
  readings.lost(why);
  charts.lost();
  allow();
}

// ------------------------------------------------------------------ buttons

// Whether each button may be pressed now; what is pressed all the same is refused by the service.
function allow() {
  const { mode, goal, lease } = contact ? state.state : {};
  const may = {
    enable: mode === "disabled",
    disable: Boolean(mode) && mode !== "disabled" && mode !== "fault",
    home: mode === "holding",
    reset: mode === "fault",
    pause: mode === "moving",
    acquire: Boolean(mode) && !lease,
    release: Boolean(mode) && lease === robot?.user,
    quick_stop: Boolean(mode) && mode !== "disabled" && mode !== "fault",
    resume: Boolean(goal) && (mode === "holding" || mode === "stopping"),
  };
  for (const button of document.querySelectorAll("[data-command]")) button.disabled = !may[button.dataset.command];
  for (const button of document.querySelectorAll(".hold, #poses button, #go")) button.disabled = !POWERED.includes(mode);
  const name = byId("pose-name").value.trim();
  byId("teach").disabled = !mode || !name;
  byId("forget").disabled = !mode || !JSON.parse(byId("forget").dataset.taught ?? "[]").includes(name);
  byId("override").disabled = !mode;
  if (!POWERED.includes(mode)) hold.end(); // a button that is disabled is not told that the finger leaves it
}

function poseButton(name) {
  const button = document.createElement("button");
  button.type = "button"; // of a form, but not what sends it
  button.textContent = name;
  button.addEventListener("click", () => {
    readings.answer(`go to ${name} …`);
    send({ do: "goto", name });
  });
  return button;
}

function naming(doing) {
  const name = byId("pose-name").value.trim();
  if (!name) return byId("pose-name").focus();
  readings.answer(`${doing} ${name} …`);
  send({ do: doing, name });
}

// What a press of a jog button does: move while it is held, or by a step.
function stepButton(length, number) {
  const button = document.createElement("button");
  button.setAttribute("role", "radio");
  button.dataset.step = number;
  button.textContent = length ?? "held";
  button.setAttribute("aria-label", stepWords(number));
  button.addEventListener("click", () => chooseStep(number));
  return button;
}

function stepWords(number) {
  return STEPS[number] === null ? "while held" : `by ${STEPS[number]} mm, ${TURNS[number]}°`;
}

function chooseStep(number) {
  hold.end();
  step = number;
  byId("step-says").textContent = stepWords(number);
  [...byId("steps").children].forEach((button, k) => button.setAttribute("aria-checked", String(k === step)));
}

// A slider's colour, dark enough for letters where the page is light.
function readable(colour) {
  if (!LIGHT.matches) return colour;
  return `#${[1, 3, 5].map((at) => Math.round(parseInt(colour.slice(at, at + 2), 16) * 0.5).toString(16).padStart(2, "0")).join("")}`;
}

function showSpeed() {
  if (robot === null) return;
  const share = robot.speeds[byId("speed").value];
  const [x, y, phi] = robot.velocity;
  const linear = share * Math.min(x, y) * 1e3;
  const angular = (share * phi * 180) / Math.PI;
  const words = `${Number(linear.toPrecision(3))} mm/s, ${Number(angular.toPrecision(3))} °/s`;
  byId("speed-says").textContent = words;
  byId("speed").setAttribute("aria-valuetext", words);
}

function showOverride(percent) {
  byId("override-says").textContent = `${percent} %`;
  byId("override").setAttribute("aria-valuetext", `${percent} %`);
}

byId("stop").addEventListener("pointerdown", stop); // when it is pressed, not when it is let go
byId("stop").addEventListener("click", (event) => event.detail === 0 && stop()); // by a key, or a screen reader
byId("speed").addEventListener("input", showSpeed);
byId("override").addEventListener("input", (event) => {
  set = performance.now();
  showOverride(event.target.value);
});
byId("override").addEventListener("change", (event) => {
  send({ do: "override", percent: Number(event.target.value) });
});
for (const button of document.querySelectorAll("[data-command]"))
  button.addEventListener("click", () => {
    readings.answer(`${button.dataset.command} …`);
    send({ do: "command", name: button.dataset.command });
  });

for (const view of byId("views").children)
  view.addEventListener("click", () => {
    for (const each of byId("views").children) {
      each.setAttribute("aria-checked", String(each === view));
      byId(each.dataset.view).toggleAttribute("hidden", each !== view);
    }
    charts.draw();
  });
byId("steps").replaceChildren(...STEPS.map(stepButton));
chooseStep(0);
byId("pose-name").addEventListener("input", allow);
byId("teaching").addEventListener("submit", (event) => {
  event.preventDefault();
  naming("teach");
});
byId("forget").addEventListener("click", () => naming("forget"));

addEventListener(
  "keydown",
  (event) => {
    const types = event.target.matches?.("input:not([type=range])");
    if (event.key === " " || event.key === "Escape") {
      event.preventDefault(); // also where a button or a field has the focus: Space is STOP
      event.stopPropagation();
      if (!event.repeat) stop();
    } else if (!types && (event.key === "+" || event.key === "-") && !event.ctrlKey && !event.metaKey) {
      byId("speed").value = Number(byId("speed").value) + (event.key === "+" ? 1 : -1);
      showSpeed();
    }
  },
  true,
);
addEventListener("keyup", (event) => event.key === " " && event.preventDefault(), true); // which would be its click

LIGHT.addEventListener("change", () => told && takes.robot(told));
allow();
connect();
