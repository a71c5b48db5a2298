// A goal and its end from JavaScript, over the WebSocket of the operator's page: node move_and_wait.js ADDRESS
// ADDRESS is what `trirail panel` prints. What is sent is described in trirail/panel/messages.py, goals and events by
// their schemas in trirail/wire/schemas.
"use strict";
const Socket = globalThis.WebSocket ?? require("ws"); // Node 22 brings it along; before: npm install ws, apt install node-ws

const socket = new Socket(process.argv[2].replace(/^http/, "ws") + "socket");
const send = (message) => socket.send(JSON.stringify(message));
const ended = new Map(); // goals that ended, by id
const [x, y, phi] = [0.01, 0.02, 0.1]; // metres and radians
let goal = null;
let seen = null; // stamp of the newest state: the panel refuses to move the robot for a program that lags behind it

function leave(words, code) {
  console.log(words);
  process.exitCode = code;
  socket.close();
}

socket.onerror = (error) => leave(`no panel at ${process.argv[2]}: ${error.message}`, 1);
socket.onclose = () => process.exitCode ?? leave("the panel has gone", 1);
socket.onmessage = ({ data }) => {
  const said = JSON.parse(data);
  if (said.tell === "refused") return leave(`refused: ${said.message}`, 1);
  if (said.tell === "state") {
    if (seen === null) send({ do: "command", name: "enable", seen: said.stamp });
    seen = said.stamp;
    send({ do: "seen", stamp: seen }); // without it, the panel sends no more states
  }
  if (said.tell === "done" && said.to === "enable") send({ do: "goal", goal: { kind: "pose", x, y, phi }, seen });
  if (said.tell === "accepted") goal = said.id;
  if (said.tell === "event" && said.event.outcome) ended.set(said.event.id, said.event);
  if (ended.has(goal)) {
    const { outcome, message } = ended.get(goal);
    leave(`${outcome} ${message}`, outcome === "done" ? 0 : 1);
  }
};
