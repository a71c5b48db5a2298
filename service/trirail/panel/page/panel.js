// The operator's page: a WebSocket to the panel's server, buttons that say what is wanted, and what the robot says.

import { Alignment } from "./alignment.js";
import { Answer } from "./answer.js";
import { Charts } from "./charts.js";
import { Commands } from "./commands.js";
import { Drawing } from "./drawing.js";
import { Events } from "./events.js";
import { Following } from "./following.js";
import { Going } from "./going.js";
import { contains } from "./hold.js";
import { Jogging } from "./jogging.js";
import { Naming } from "./naming.js";
import { Outputs } from "./outputs.js";
import { Readings } from "./readings.js";
import { Sessions } from "./sessions.js";
import { refusal, useLabels } from "./service_words.js";
import "./sliders.js"; // before the others listen to sliders
import { onLanguage, say } from "./words.js";

const LEASED = { acquire: true, takeover: true, release: false }; // commands that take or give back the lease
const SEEN = ["hold", "goal", "follow", "command", "takeover", "teach", "forget"]; // messages that carry the stamp of the newest state that was drawn
const BUTTONS = [1, 4, 2, 8, 16, 32]; // of each button of a pointer, its bit in `buttons`
const AGAIN = 500; // after so long a lost connection is tried again [ms]

const LIGHT = matchMedia("(prefers-color-scheme: light)");

const byId = (id) => document.getElementById(id);
let socket = null;
let told = null; // the robot, as the server tells of it
let robot = null; // the same in colours that can be read
let drawing = null;
let state = null;
let contact = false; // whether the state is of now
let seen = 0; // the stamp of the newest state that was drawn
let drawn = true;
let heard = 0;

const now = () => ({ robot, drawing, state: contact ? state : null, pose: contact && homed(state) ? state.pose : null });
const homed = ({ sliders }) => sliders.homed.every(Boolean); // without one position the pose is unknown
const line = new Answer(byId("answer"));
const answer = (what) => line.asked(what);
const note = (words) => (words ? line.refused(words) : line.clear());
const events = new Events(byId("events"));
const readings = new Readings(events.faults);
export const charts = new Charts();
const alignment = new Alignment(byId("alignment"), document.querySelector("[data-view=alignment]"));
const commands = new Commands(send, now, answer, note);
const jogging = new Jogging(send, now, answer, note, stop);
const speed = () => jogging.speed;
const going = new Going(send, now, answer, speed);
const following = new Following(send, sendPart, now, allow, answer, speed);
const naming = new Naming(send, allow, answer, speed, note);
const outputs = new Outputs(send, answer);
const sessions = new Sessions();

// ------------------------------------------------------------------ to the server

// What acts on what the operator saw carries the stamp of that state: the server refuses it where that is old, but no stop.
function send(message) {
  const whole = SEEN.includes(message.do) ? { ...message, seen } : message;
  if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify(whole));
  else if (socket) note(say("not_sent"));
}

// A part of a file, which is no JSON.
function sendPart(bytes) {
  if (socket?.readyState === WebSocket.OPEN) socket.send(bytes);
}

function stop() {
  jogging.end();
  answer(say("do.stop"));
  send({ do: "command", name: "stop" });
}

function connect() {
  socket = new WebSocket(new URL("socket", location.href.replace(/^http/, "ws")));
  socket.onopen = () => following.upload();
  socket.onmessage = (event) => take(JSON.parse(event.data));
  socket.onclose = () => {
    lost("panel");
    setTimeout(connect, AGAIN);
  };
}

// ------------------------------------------------------------------ from the server

const takes = {
  robot(said) {
    told = said;
    robot = { ...said, colours: { ...said.colours, sliders: said.colours.sliders.map(readable) } };
    useLabels(robot.sliders);
    drawing = new Drawing(byId("mechanism"), robot);
    readings.robot(robot);
    charts.robot(robot);
    outputs.robot(robot);
    commands.roles(robot);
    jogging.show();
    going.show();
    following.robot();
    allow();
  },
  state(said) {
    state = said.state;
    state.stamp = said.stamp;
    if (!contact) line.clear(); // as that nothing could be sent
    contact = true;
    heard = performance.now();
    if (drawn) requestAnimationFrame(draw); // a hidden page draws nothing, and is sent no more
    drawn = false;
  },
  event({ event }) {
    if (events.add(event)) alignment.event(event);
    line.event(event);
    commands.event(event);
    outputs.event(event, drawing);
  },
  silent({ trouble }) {
    lost(trouble ? "description" : "service", trouble);
  },
  ended(told) {
    jogging.end();
    line.refused("", refusal(told));
  },
  refused({ to, name, ...told }) {
    line.refused(say("answer.refused", { what: what(to, name) }), refusal(told));
  },
  done({ to, name, seq }) {
    line.done(what(to, name), seq, ({ lease }) => !(to in LEASED) || LEASED[to] === (lease === robot.user));
  },
  accepted({ to, name, id }) {
    if (to === "follow") following.accepted(id);
    line.accepted(what(to, name), id);
  },
  poses(said) {
    naming.poses(said);
  },
  users({ names }) {
    commands.users = names.join(", ");
  },
  checked(said) {
    going.checked(said);
  },
  received(said) {
    following.received(said);
  },
  path(said) {
    following.checked(said);
  },
};

const what = (to, name) => say(`do.${to}`, { name }, to);

function take(said) {
  takes[said.tell](said);
}

function draw() {
  drawn = true;
  seen = state.stamp;
  send({ do: "seen", stamp: seen }); // also where contact was lost meanwhile: without it no more is sent
  if (!contact) return;
  document.body.dataset.contact = "yes";
  drawing.show(state);
  if (!old()) charts.state(state, performance.now()); // a page that was hidden first draws the state of before
  readings.state(state);
  outputs.state(state);
  line.state(state);
  going.state(state);
  commands.show();
  following.state(state);
  allow();
}

const old = () => performance.now() - heard > robot.state_timeout * 1e3;

setInterval(() => {
  if (contact && drawn && !document.hidden && old()) lost("old");
}, 250);

function lost(why, trouble = "") {
  jogging.end();
  contact = false;
  document.body.dataset.contact = "none";
  readings.lost(say(`lost.${why}`, { trouble }));
  charts.lost();
  outputs.lost();
  going.lost();
  following.lost();
  line.clear();
  commands.show();
  allow();
}

// ------------------------------------------------------------------ buttons and keys

function allow() {
  const choice = { file: following.choice, name: naming.name, names: naming.names, taught: naming.taught };
  if (!commands.allow(choice)) jogging.end(); // a button that is disabled is not told that the finger leaves it
}

// A slider's colour, dark enough for letters where the page is light.
function readable(colour) {
  if (!LIGHT.matches) return colour;
  return `#${[1, 3, 5].map((at) => Math.round(parseInt(colour.slice(at, at + 2), 16) * 0.5).toString(16).padStart(2, "0")).join("")}`;
}

// Buttons of which one is chosen; each shows the element of its data-view, and hides those of the others.
function views(group, shown = () => {}) {
  for (const view of byId(group).children)
    view.addEventListener("click", () => {
      for (const each of byId(group).children) {
        each.setAttribute("aria-pressed", String(each === view));
        byId(each.dataset.view).toggleAttribute("hidden", each !== view);
      }
      shown(view.dataset.view);
    });
}

views("views", (view) => (view === "sessions" ? sessions.ask() : charts.draw()));
views("ways");
// When it is pressed, not when it is let go; by any button of a mouse, also while another one is held, which the browser
// tells as a move (https://www.w3.org/TR/pointerevents/#chorded-button-interactions); and whatever lies above it.
const onStop = (event) => byId("stop").contains(event.target) || contains(byId("stop"), event);
addEventListener("pointerdown", (event) => onStop(event) && pressed(event), true);
addEventListener("pointermove", (event) => event.buttons & BUTTONS[event.button] && onStop(event) && pressed(event), true);
byId("stop").addEventListener("click", (event) => event.detail === 0 && stop()); // by a key, or a screen reader

function pressed(event) {
  stop();
  if (byId("stop").contains(event.target)) return;
  event.preventDefault(); // as an entry of an open list
  event.stopPropagation();
  byId("stop").focus();
}

// STOP stays on the screen where the page is magnified, scrolled, or partly covered, as by a keyboard on the screen.
for (const seen of [visualViewport, window])
  for (const kind of ["resize", "scroll"])
    seen.addEventListener(kind, () => {
      const { scale, offsetLeft, offsetTop, height } = visualViewport;
      byId("stop").style.transform = "";
      const at = byId("stop").getBoundingClientRect();
      const top = offsetTop + Math.max(0, Math.min(at.top / scale, height - at.height / scale));
      byId("stop").style.transform = `translate(${offsetLeft + at.left / scale - at.left}px, ${top - at.top}px) scale(${1 / scale})`;
    });

// Layouts and input methods may have other names for the keys; a keyboard on a screen may tell only the text.
const stops = ({ key, code }) => key === " " || key === "Escape" || code === "Space" || code === "Escape";
addEventListener("beforeinput", (event) => {
  if (event.inputType !== "insertText" || !/^\s+$/.test(event.data ?? "")) return;
  event.preventDefault();
  stop();
});
const control = ({ target }) => target.closest?.("select") ?? target; // an entry of a list belongs to it
const began = new Map(); // where each key was pressed
addEventListener("blur", () => began.clear());
addEventListener(
  "keydown",
  (event) => {
    const types = event.target.matches?.("input:not([type=range])");
    if (!event.repeat) began.set(event.code, control(event));
    if (stops(event)) {
      event.preventDefault(); // also where a button or a field has the focus: Space is STOP
      event.stopPropagation();
      if (!event.repeat) stop();
    } else if (event.repeat && event.key !== "Tab" && began.get(event.code) !== control(event)) {
      event.preventDefault(); // a key that was pressed elsewhere, as to jog, does nothing to what has the focus later
    } else if (event.key === "Enter" && event.repeat) {
      event.preventDefault(); // a key that is held presses once, and confirms nothing
    } else if (!types && (event.key === "+" || event.key === "-") && !event.ctrlKey && !event.metaKey) {
      jogging.faster(event.key === "+" ? 1 : -1);
    }
  },
  true,
);
addEventListener("keyup", (event) => stops(event) && event.preventDefault(), true); // which would be its click

const again = () => {
  if (told) takes.robot(told);
  line.clear();
};
LIGHT.addEventListener("change", again);
onLanguage(again);
readings.waits();
allow();
connect();
