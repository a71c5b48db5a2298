// The operator's page: a WebSocket to the panel's server, buttons that say what is wanted, and what the robot says.

import { Drawing } from "./drawing.js";
import { Hold } from "./hold.js";
import { Readings } from "./readings.js";

const SILENT = 1500; // without a state for so long, what is shown is old [ms]
const SETTING = 1000; // for so long the override's slider is the operator's, then it shows the robot's again [ms]
const AGAIN = 500; // after so long a lost connection is tried again [ms]
const POWERED = ["holding", "moving", "stopping"]; // modes in which a jog may begin

const byId = (id) => document.getElementById(id);
const readings = new Readings();
let socket = null;
let robot = null;
let drawing = null;
let state = null;
let contact = false; // whether the state is of now
let seen = 0; // the stamp of the newest state that was drawn
let drawn = true;
let heard = 0;
let set = -Infinity; // when the override's slider was last moved by the operator

// ------------------------------------------------------------------ to the server

function send(message) {
  if (socket?.readyState !== WebSocket.OPEN) return readings.answer("not sent: no contact with the panel's server", true);
  socket.send(JSON.stringify(message));
}

const hold = new Hold(
  document.querySelectorAll(".hold"),
  (direction) => {
    const [x, y, phi] = robot.velocity;
    const speed = robot.speeds[byId("speed").value];
    send({ do: "hold", velocity: [direction.x * speed * x, direction.y * speed * y, direction.phi * speed * phi], seen });
  },
  () => send({ do: "release" }),
);

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
    robot = said;
    drawing = new Drawing(byId("mechanism"), said);
    readings.robot(said);
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
  poses({ names }) {
    byId("poses-part").hidden = names.length === 0;
    byId("poses").replaceChildren(...names.map(poseButton));
    allow();
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
    resume: Boolean(goal) && (mode === "holding" || mode === "stopping"),
  };
  for (const button of document.querySelectorAll("[data-command]")) button.disabled = !may[button.dataset.command];
  for (const button of document.querySelectorAll(".hold, #poses button")) button.disabled = !POWERED.includes(mode);
  byId("override").disabled = !mode;
  if (!POWERED.includes(mode)) hold.end(); // a button that is disabled is not told that the finger leaves it
}

function poseButton(name) {
  const button = document.createElement("button");
  button.textContent = name;
  button.addEventListener("click", () => {
    readings.answer(`go to ${name} …`);
    send({ do: "goto", name });
  });
  return button;
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

addEventListener(
  "keydown",
  (event) => {
    if (event.key === " " || event.key === "Escape") {
      event.preventDefault(); // also where a button has the focus: Space presses none but STOP
      event.stopPropagation();
      if (!event.repeat) stop();
    } else if ((event.key === "+" || event.key === "-") && !event.ctrlKey && !event.metaKey) {
      byId("speed").value = Number(byId("speed").value) + (event.key === "+" ? 1 : -1);
      showSpeed();
    }
  },
  true,
);
addEventListener("keyup", (event) => event.key === " " && event.preventDefault(), true); // which would be its click

allow();
connect();
