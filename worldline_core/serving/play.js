"use strict";
const $ = (id) => document.getElementById(id);
const colours = { left: "#ff9d4d", right: "#6ea6ff" };
const play = { blocks: 0, node: null, marks: null, position: null, saved: null, latency: [], shown: 0, error: null };
window.play = play;  // what tests and the curious read
let hello = null, started = null, running = false, behind = false, asked = false, arm = 0, goal = null;
let nodes = new Map(), queue = [], showing = null, ticks = 0, due = [], begun = 0, seen = [];
let untaken = 0, busy = false;  // commands that the server has not answered yet, and whether there are too many
const keys = new Set();
const token = new URLSearchParams(location.hash.slice(1)).get("token");
const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/play/session${token ? `?token=${encodeURIComponent(token)}` : ""}`);
socket.binaryType = "arraybuffer";
const tell = (message) => socket.readyState === 1 && socket.send(JSON.stringify(message));
const say = (text, bad) => { $("said").textContent = text; $("said").className = bad ? "bad" : "muted"; };
socket.addEventListener("close", (event) => { run(false); say(`Disconnected${event.reason ? `: ${event.reason}` : ""}. Load the page again; a server with a token wants …/play#token=TOKEN.`, true); });

const counted = (views) => `${views.length} ${views.length === 1 ? "view" : "views"}`;
const bool = (on) => (on ? 1 : 0);
const down = (more, less) => bool(keys.has(more)) - bool(keys.has(less));
const dead = (value) => (Math.abs(value || 0) < 0.15 ? 0 : value);
const limit = (value) => Math.max(-1, Math.min(1, value));
// A browser has gamepads on secure pages alone: on this machine, or by https.
const gamepad = () => [...(navigator.getGamepads?.() ?? [])].find((found) => found && found.mapping === "standard");
function wish() {
  const move = [down("d", "a"), down("w", "s"), down("e", "q")], turn = [down("k", "i"), down("o", "u"), down("j", "l")];
  let grip = down("x", "z");
  const pad = gamepad();
  if (pad) {
    const [x, y, yaw, lift] = pad.axes.map(dead);
    move[0] += x; move[1] -= y; move[2] -= lift; turn[2] -= yaw;
    grip += pad.buttons[7].value - pad.buttons[6].value;
  }
  return { move: move.map(limit), turn: turn.map(limit), grip: limit(grip), goal };
}
const wished = ({ move, turn, grip }) => [...move, ...turn, grip].some((value) => value !== 0);
let held = false;
function padButtons() {
  const pad = gamepad();
  const pressed = pad && (pad.buttons[4].pressed || pad.buttons[5].pressed || pad.buttons[9].pressed);
  if (pressed && !held) pad.buttons[9].pressed ? run(!running) : choose(arm + 1);
  held = Boolean(pressed);
}
function choose(index) { arm = (index + started.arms.length) % started.arms.length; $("arm").value = arm; }
function run(on) { if (on && started && !running) say(""); running = Boolean(on && started); $("run").setAttribute("aria-pressed", running); $("run").textContent = running ? "Pause" : "Run"; }

// One frame: show the next picture, and send what is wished for the next command.
function frame() {
  if (!started) return;
  padButtons();
  if (queue.length) {
    showing = queue.shift();
    play.shown += 1;
    seen.push(performance.now());
    seen = seen.filter((time) => time > performance.now() - 3000);
    if (seen.length > 3) $("rate").textContent = `${(1000 * (seen.length - 1) / (seen.at(-1) - seen[0])).toFixed(1)} frames/s of ${counted(started.views)}`;
  }
  if (running && $("driver").value && wished(wish())) { byHand(); run(true); }
  const policy = $("driver").value;
  if (running && policy) {
    if (!asked && queue.length <= started.frames_per_step / 2) { asked = true; due.push(performance.now()); tell({ type: "advance", policy }); }
  } else if (running && !behind && untaken >= hello.fps) {
    busy = true;
    say(`The server is busy: it has not taken ${untaken} commands (${(untaken / hello.fps).toFixed(1)} s). Further ones wait.`);
  } else if (running && !behind) {
    tell({ type: "tick", arms: started.arms.map((_, index) => (index === arm ? wish() : {})) });
    ticks += 1; untaken += 1;
    if (ticks % started.frames_per_step === 0) due.push(performance.now());
  }
  draw();
}

function draw() {
  for (const canvas of document.querySelectorAll("#views canvas")) {
    const view = canvas.dataset.view, pen = canvas.getContext("2d");
    if (showing) {
      const picture = showing.pictures[view];
      const scale = Math.max(1, Math.round(960 / picture.width));
      if (canvas.width !== picture.width * scale) { canvas.width = picture.width * scale; canvas.height = picture.height * scale; }
      pen.imageSmoothingQuality = "high";
      pen.drawImage(picture, 0, 0, canvas.width, canvas.height);
      (showing.marks[view] || []).forEach((mark, index) => ring(pen, canvas, mark, index));
    }
    if (play.marks) (play.marks[view] || []).forEach((mark, index) => cross(pen, canvas, mark, index));
  }
}
const colour = (index) => colours[started.arms[index]] || "#4fc793";
function ring(pen, canvas, mark, index) {
  if (!mark) return;
  const [x, y] = [mark.at[0] * canvas.width, mark.at[1] * canvas.height];
  pen.lineWidth = canvas.width / 240;
  pen.strokeStyle = colour(index);
  pen.beginPath(); pen.arc(x, y, canvas.width * (0.008 + 0.012 * mark.open), 0, 7); pen.stroke();
  if (mark.tip) { pen.beginPath(); pen.moveTo(x, y); pen.lineTo(mark.tip[0] * canvas.width, mark.tip[1] * canvas.height); pen.stroke(); }
}
function cross(pen, canvas, mark, index) {
  if (!mark) return;
  const [x, y, r] = [mark.at[0] * canvas.width, mark.at[1] * canvas.height, canvas.width * (index === arm ? 0.022 : 0.012)];
  for (const [style, width] of [["#14161a", canvas.width / 120], [colour(index), canvas.width / 260]]) {
    pen.strokeStyle = style; pen.lineWidth = width;
    pen.beginPath(); pen.moveTo(x - r, y); pen.lineTo(x + r, y); pen.moveTo(x, y - r); pen.lineTo(x, y + r); pen.stroke();
  }
}

async function block(data) {
  const length = new DataView(data).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
  let offset = 4 + length;
  const made = [];
  for (const size of head.sizes) { made.push(createImageBitmap(new Blob([new Uint8Array(data, offset, size)], { type: "image/jpeg" }))); offset += size; }
  const pictures = await Promise.all(made);
  const frames = [];
  for (let i = 0; i < head.frames; i += 1) {
    frames.push({ marks: head.marks[i], pictures: Object.fromEntries(head.views.map((view, v) => [view, pictures[i * head.views.length + v]])) });
  }
  nodes.set(head.node, { parent: head.parent, driver: head.driver, last: frames.at(-1) });  // all pictures would fill the memory
  play.node = head.node; play.blocks = nodes.size - 1;
  asked = false; behind = false;
  if (head.node === 0) { queue = []; showing = frames[0]; $("first").textContent = `${((performance.now() - begun) / 1000).toFixed(2)} s`; }
  else {
    queue.push(...frames);
    if (due.length) { const waited = performance.now() - due.shift(); play.latency.push(waited); $("latency").textContent = `${(waited / 1000).toFixed(2)} s`; }
    const ahead = head.seconds < 0.001;  // it was there when it was asked for
    $("computed").textContent = ahead ? "advance" : `${head.seconds.toFixed(2)} s`;
    if (!ahead) $("ratio").textContent = `${(head.frames / hello.fps / head.seconds).toFixed(1)} ×`;
  }
  tree();
  draw();
}

// A row for each branch; a moment stands in the column of its depth.
function tree() {
  const box = $("tree"), depth = new Map(), row = new Map(), ends = new Set();
  let rows = 0;
  box.replaceChildren();
  for (const [number, node] of [...nodes].sort(([a], [b]) => a - b)) {
    depth.set(number, node.parent === null ? 0 : depth.get(node.parent) + 1);
    row.set(number, node.parent === null || ends.has(node.parent) ? (rows += 1) : row.get(node.parent));
    if (node.parent !== null) ends.add(node.parent);
    const button = document.createElement("button");
    button.textContent = number === 0 ? "start" : `${(depth.get(number) * started.frames_per_step / hello.fps).toFixed(0)} s`;
    button.style.gridColumn = depth.get(number) + 1;
    button.style.gridRow = row.get(number);
    button.title = `${node.driver}, block ${number}`;
    if (node.driver !== "by hand") button.classList.add("policy");
    button.setAttribute("aria-pressed", number === play.node);
    button.addEventListener("click", () => go(number));
    box.append(button);
  }
}
function go(number) {
  run(false);
  const node = nodes.get(number);
  if (!node) return;
  play.node = number; queue = []; due = []; ticks = 0; asked = false; showing = node.last;
  tell({ type: "go", node: number });
  tree(); draw();
  say(`At ${number === 0 ? "the start" : `block ${number}`}: what follows is a branch of its own.`);
}
// A hand at keys, mouse or gamepad takes over from a policy.
function byHand() { if ($("driver").value) { $("driver").value = ""; go(play.node); } }
const back = () => { const node = nodes.get(play.node); if (node && node.parent !== null) go(node.parent); };

socket.addEventListener("message", ({ data }) => {
  if (data instanceof ArrayBuffer) { chain = chain.then(() => block(data)); return; }
  const message = JSON.parse(data);
  if (message.type === "hello") {
    hello = message;
    for (const row of message.episodes) $("episode").add(new Option(`${row.embodiment}: ${row.instruction} (${row.id})`, row.id));
    for (const name of message.policies) $("driver").add(new Option(`by ${name}`, name));
    const wanted = new URLSearchParams(location.search).get("episode");
    if (wanted) $("episode").value = wanted;
    $("about").textContent = `${message.episodes.length} recordings to start from · ${message.fps} frames/s · ${counted(message.views)}`;
    setInterval(frame, 1000 / message.fps);
    start();
  } else if (message.type === "started") {
    started = message; nodes = new Map(); queue = []; showing = null; ticks = 0; due = []; goal = null; asked = false; behind = false; untaken = 0;
    $("about").textContent = `${message.embodiment} · ${message.instruction}`;
    $("views").replaceChildren(...message.views.map((view) => {
      const figure = document.createElement("figure"), canvas = document.createElement("canvas"), caption = document.createElement("figcaption");
      canvas.dataset.view = view; caption.textContent = view.replaceAll("_", " ");
      pointer(canvas);
      figure.append(canvas, caption);
      return figure;
    }));
    $("arm").replaceChildren(...message.arms.map((name, index) => new Option(name, index)));
    choose(message.arms.length - 1);
    for (const button of document.querySelectorAll("button:disabled")) button.disabled = false;
    say("Hold a key or a button beside the pictures, or drag a tool.");
  } else if (message.type === "marks") {
    play.marks = message.views; play.position = message.position; untaken = Math.max(0, untaken - 1);
    if (busy && untaken < hello.fps / 2) { busy = false; say(""); }
    $("pending").textContent = `${message.pending + untaken} of ${started.frames_per_step}`;
  } else if (message.type === "behind") {
    behind = true; ticks -= 1; untaken = Math.max(0, untaken - 1);
    if ((ticks + 1) % started.frames_per_step === 0) due.pop();
    say("The simulator is behind: commands wait until its pictures have caught up.");
  } else if (message.type === "saved") {
    play.saved = message;
    say(`Saved ${message.frames} frames: ${message.path}`);
  } else if (message.type === "error") {
    play.error = message; asked = false; behind = false; due = []; untaken = 0;
    run(false);
    say([message.what, message.where, message.expected && `expected ${message.expected}`, message.got && `got ${message.got}`, message.next_step].filter(Boolean).join(" · "), true);
  }
});
let chain = Promise.resolve();

function pointer(canvas) {
  const place = (event) => {
    const box = canvas.getBoundingClientRect();
    return [limit((event.clientX - box.left) / box.width), limit((event.clientY - box.top) / box.height)].map((share) => Math.max(0, share));
  };
  canvas.addEventListener("pointerdown", (event) => {
    const [u, v] = place(event), view = canvas.dataset.view;
    const away = (play.marks?.[view] || []).map((mark) => (mark ? Math.hypot(mark.at[0] - u, mark.at[1] - v) : 9));
    const nearest = away.indexOf(Math.min(...away));
    if (nearest < 0 || away[nearest] > 0.15) return;
    choose(nearest);
    byHand();
    goal = { view, u, v };
    canvas.setPointerCapture(event.pointerId);
    run(true);
  });
  canvas.addEventListener("pointermove", (event) => { if (goal && goal.view === canvas.dataset.view) { const [u, v] = place(event); goal = { view: goal.view, u, v }; } });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => { goal = null; });
}
document.addEventListener("keydown", (event) => {
  if (!started || event.ctrlKey || event.metaKey || event.altKey || /^(SELECT|INPUT)$/.test(event.target.tagName)) return;
  const key = event.key.toLowerCase();
  if (key === "p") run(!running);
  else if (key === "tab") choose(arm + 1);
  else if (key === "backspace") back();
  else if (button(key)) press(key);
  else return;
  event.preventDefault();
});
const button = (key) => document.querySelector(`[data-key="${CSS.escape(key)}"]`);
function press(key) {
  keys.add(key);
  button(key).classList.add("held");
  byHand();
  run(true);
}
function release(key) { keys.delete(key); button(key)?.classList.remove("held"); }
document.addEventListener("keyup", (event) => release(event.key.toLowerCase()));
addEventListener("blur", () => [...keys].forEach(release));
function start() {
  run(false);
  begun = performance.now();
  say("Starting …");
  tell({ type: "start", episode: $("episode").value, seed: Number($("seed").value) });
}
for (const id of ["episode", "seed"]) $(id).addEventListener("change", () => { start(); $(id).blur(); });
$("start").addEventListener("click", () => { start(); $("start").blur(); });
// A button is held like a key: with the finger on it the arm moves.
for (const button of document.querySelectorAll("[data-key]")) {
  const { key } = button.dataset;
  button.addEventListener("pointerdown", (event) => { button.setPointerCapture(event.pointerId); press(key); });
  for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) button.addEventListener(end, () => release(key));
  button.addEventListener("contextmenu", (event) => event.preventDefault());
}
$("other").addEventListener("click", () => { choose(arm + 1); $("other").blur(); });
$("run").addEventListener("click", () => { run(!running); $("run").blur(); });
$("back").addEventListener("click", back);
$("driver").addEventListener("change", () => { go(play.node); $("driver").blur(); });
$("arm").addEventListener("change", () => { arm = Number($("arm").value); $("arm").blur(); });
$("save").addEventListener("click", () => { run(false); say("Saving …"); tell({ type: "save" }); $("save").blur(); });
