// The labelling page: shows a frame, takes strokes, saves each at once.

import { Strokes } from "./strokes.js";

const KEYS = "1234567890qwrtyuioadfghjklxcvbm";  // of classes; e, z, n, p, s have another meaning
const RETRY_MS = 2000;
const $ = (id) => document.getElementById(id);
const stage = $("stage"), sheet = $("sheet"), image = $("image"), brush = $("brush");

let session, at = 0, number = -1, strokes = null, current = null;  // current: id of the class that is painted
let pen = null;  // where the stroke that is being painted is; {x, y, pointer}
let keyboard = { x: 0, y: 0, down: false };
let growing = 0;  // number of the last request for grown strokes
let size = 16;  // pixels of the frame, across

// ---- saving: one request at a time, the newest state last

const unsaved = new Map();  // by frame: {ids}, a new one after each change, until the server has said that it has them
const revisions = new Map();  // of frames, as the server has given them: what has changed there since is not replaced
let saving = null;

function changed() {
  unsaved.set(number, { ids: strokes.ids });
  $("undo").disabled = !strokes.undoable;
  save();
}

function save() {
  saving ??= sendAll().finally(() => { saving = null; if (unsaved.size) setTimeout(save, RETRY_MS); });
  return saving;
}

async function sendAll() {
  while (unsaved.size) {
    const [frame, state] = unsaved.entries().next().value, ids = state.ids.slice();
    say("saving");
    try {
      const headers = { "If-Match": revisions.get(frame) };
      const answer = await request(`frames/${frame}/label`, { method: "PUT", body: ids, headers });
      revisions.set(frame, answer.headers.get("ETag"));
      if (unsaved.get(frame) === state) unsaved.delete(frame);
    } catch (error) {
      if (error.status === 412) {
        unsaved.delete(frame);
        if (frame === number) await show(frame);
        say(`${error.message}; shown as it is now, without the last stroke`, true);
        return;
      }
      say(`not saved: ${error.message}`, true);
      return;
    }
    const painted = ids.some((id) => id !== session.ignore);
    session.labelled = session.labelled.filter((n) => n !== frame).concat(painted ? [frame] : []);
    showPlace();
  }
  say("saved");
  grow();
}

// Shows what the strokes of this frame grow to, as the server has them.
async function grow() {
  const mine = ++growing, of = number, canvas = $("grown");
  canvas.hidden = !$("grow").checked;
  if (canvas.hidden) return;
  try {
    const ids = new Uint8Array(await (await request(`frames/${of}/grown`)).arrayBuffer());
    if (mine === growing && of === number) new Strokes(canvas, image.width, image.height, ids, colorsById(), session.ignore);
  } catch (error) {
    say(`strokes do not grow: ${error.message}`, true);
  }
}

function colorsById() {
  return Object.fromEntries(session.classes.map((c) => [c.id, c.color]));
}

async function request(path, options) {
  let answer;
  try {
    answer = await fetch(path, options);
  } catch {
    throw new Error("`label --serve` does not answer; is it still running?");
  }
  if (!answer.ok) {
    const { error } = await answer.json().catch(() => ({}));
    throw Object.assign(new Error(error ?? answer.statusText), { status: answer.status });
  }
  return answer;
}

function say(text, bad = false) {
  $("status").textContent = text;
  $("status").classList.toggle("bad", bad);
  $("again").hidden = !bad || unsaved.size === 0;
}

addEventListener("beforeunload", (event) => { if (unsaved.size || saving) event.preventDefault(); });

// ---- frames

let showing = 0;

async function load(wanted) {
  const answer = await request(`frames/${wanted}/label`);
  const ids = new Uint8Array(await answer.arrayBuffer());
  revisions.set(wanted, answer.headers.get("ETag"));
  return ids;
}

async function show(wanted) {
  const mine = ++showing;
  endStroke();
  say("loading");
  try {
    const ids = unsaved.get(wanted)?.ids ?? await load(wanted);
    const picture = new Image();
    picture.src = `frames/${wanted}/image`;
    await picture.decode();
    if (mine !== showing) return;  // another one was requested meanwhile
    endStroke();
    image.width = picture.naturalWidth;
    image.height = picture.naturalHeight;
    image.getContext("2d").drawImage(picture, 0, 0);
    strokes = new Strokes($("paint"), image.width, image.height, ids, colorsById(), session.ignore);
  } catch (error) {
    if (mine !== showing) return;
    say(`frame ${wanted} cannot be shown: ${error.message}`, true);
    showPlace();
    return;
  }
  number = wanted;
  keyboard = { x: image.width / 2, y: image.height / 2, down: false };
  brush.hidden = true;
  $("number").value = number;
  $("undo").disabled = true;
  showPlace();
  fit();
  $("grown").width = image.width;  // clears what another frame has left
  if (unsaved.size) save(); else say(session.labelled.includes(number) ? "saved" : "nothing painted yet");
  grow();
}

function showPlace() {
  const done = session.order.filter((n) => session.labelled.includes(n)).length;
  const place = session.order.indexOf(number);
  $("place").textContent = place < 0 ? `frame ${number} is not among the suggested ones`
    : `${place + 1} of ${session.order.length} frames to label, ${done} labelled`;
  $("previous").disabled = at <= 0;
  $("next").disabled = at >= session.order.length - 1;
}

function go(step) {
  const wanted = at + step;
  if (wanted < 0 || wanted >= session.order.length) return;
  at = wanted;
  show(session.order[at]);
}

function fit() {
  if (!strokes) return;
  const scale = Math.min((stage.clientWidth - 20) / image.width, (stage.clientHeight - 20) / image.height);
  const zoom = scale * $("zoom").value / 100;
  sheet.style.width = `${image.width * zoom}px`;
  sheet.style.height = `${image.height * zoom}px`;
  showBrush();
}

// ---- painting

function place(event) {
  const box = sheet.getBoundingClientRect();
  return { x: (event.clientX - box.left) * image.width / box.width, y: (event.clientY - box.top) * image.height / box.height };
}

function beginStroke(x, y, pointer) {
  if (!strokes || pen) return;
  strokes.begin();
  pen = { x, y, pointer };
  strokes.line(x, y, x, y, size, current);
}

function moveStroke(x, y) {
  strokes.line(pen.x, pen.y, x, y, size, current);
  pen.x = x;
  pen.y = y;
}

function endStroke() {
  if (!pen) return;
  pen = null;
  keyboard.down = false;
  if (strokes.end()) changed();
}

function showBrush(x = keyboard.x, y = keyboard.y) {
  if (!strokes) return;
  const scale = sheet.clientWidth / image.width;
  Object.assign(brush.style, {
    left: `${x * scale}px`, top: `${y * scale}px`, width: `${size * scale}px`, height: `${size * scale}px`,
  });
  brush.classList.toggle("down", keyboard.down);
}

sheet.addEventListener("pointerdown", (event) => {
  if (event.button !== 0 || pen) return;
  event.preventDefault();
  stage.focus({ preventScroll: true });
  sheet.setPointerCapture(event.pointerId);
  const { x, y } = place(event);
  beginStroke(x, y, event.pointerId);
});
sheet.addEventListener("pointermove", (event) => {
  const last = place(event);
  if (pen?.pointer === event.pointerId) {
    const events = event.getCoalescedEvents?.() ?? [];
    for (const part of events.length ? events : [event]) { const { x, y } = place(part); moveStroke(x, y); }
  }
  if (event.pointerType !== "touch") { keyboard.x = last.x; keyboard.y = last.y; brush.hidden = false; showBrush(); }
});
for (const kind of ["pointerup", "pointercancel", "lostpointercapture"]) {
  sheet.addEventListener(kind, (event) => { if (pen?.pointer === event.pointerId) endStroke(); });
}
sheet.addEventListener("pointerleave", () => { if (document.activeElement !== stage || !keyboard.down) brush.hidden = true; });

function moveBrush(dx, dy, far) {
  const step = Math.max(1, size / 2) * (far ? 5 : 1);
  keyboard.x = Math.min(Math.max(keyboard.x + dx * step, 0), image.width - 1);
  keyboard.y = Math.min(Math.max(keyboard.y + dy * step, 0), image.height - 1);
  if (keyboard.down && pen) moveStroke(keyboard.x, keyboard.y);
  brush.hidden = false;
  showBrush();
  brush.scrollIntoView({ block: "nearest", inline: "nearest" });
}

stage.addEventListener("keydown", (event) => {
  if (!strokes || event.ctrlKey || event.metaKey || event.altKey) return;
  const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  if (event.key in arrows) {
    moveBrush(...arrows[event.key], event.shiftKey);
  } else if (event.key === " " && !pen) {
    beginStroke(keyboard.x, keyboard.y, "keyboard");
    endStroke();
  } else if (event.key === "Enter") {
    if (keyboard.down) endStroke();
    else if (!pen) { beginStroke(keyboard.x, keyboard.y, "keyboard"); keyboard.down = true; }
    brush.hidden = false;
    showBrush();
  } else {
    return;
  }
  event.preventDefault();
});
stage.addEventListener("blur", () => { if (pen?.pointer === "keyboard") endStroke(); });

// ---- tools

function choose(id) {
  endStroke();
  current = id;
  $("eraser").setAttribute("aria-pressed", String(id === session.ignore));
  for (const button of $("classes").children) {
    const chosen = Number(button.dataset.id) === id;
    button.setAttribute("aria-checked", String(chosen));
    button.tabIndex = chosen || (id === session.ignore && !button.previousSibling) ? 0 : -1;
  }
}

function setBrush(pixels) {
  size = Math.min(Math.max(Math.round(pixels), 1), 100);
  $("size").value = size;
  $("size-text").textContent = `${size} px`;
  showBrush();
}

function setOpacity(percent) {
  $("opacity").value = percent;
  $("paint").style.opacity = $("opacity").value / 100;
  $("grown").style.opacity = $("opacity").value / 200;
  $("opacity-text").textContent = `${$("opacity").value} %`;
}

function undo() {
  endStroke();
  if (strokes?.undo()) changed();
}

function listClasses() {
  session.classes.forEach((entry, place) => {
    const button = document.createElement("button"), swatch = document.createElement("i");
    button.setAttribute("role", "radio");
    button.dataset.id = entry.id;
    swatch.style.background = `rgb(${entry.color.join(" ")})`;
    button.append(swatch, entry.name);
    if (KEYS[place]) {
      const key = document.createElement("kbd");
      key.textContent = KEYS[place];
      button.append(key);
    }
    button.addEventListener("click", () => choose(entry.id));
    $("classes").append(button);
  });
}

$("classes").addEventListener("keydown", (event) => {
  const step = { ArrowDown: 1, ArrowRight: 1, ArrowUp: -1, ArrowLeft: -1 }[event.key];
  if (!step) return;
  const buttons = [...$("classes").children], next = buttons[(buttons.indexOf(event.target) + step + buttons.length) % buttons.length];
  choose(Number(next.dataset.id));
  next.focus();
  event.preventDefault();
});

document.addEventListener("keydown", (event) => {
  if (event.altKey || ((event.ctrlKey || event.metaKey) && event.key !== "z") || event.target.type === "number") return;
  if (event.target.type === "range" && event.key.startsWith("Page")) return;
  const place = KEYS.indexOf(event.key);
  if (event.key.length === 1 && place >= 0 && place < session.classes.length) choose(session.classes[place].id);
  else if (event.key === "e") choose(session.ignore);
  else if (event.key === "z") undo();
  else if (event.key === "[") setBrush(Math.min(size / 1.25, size - 1));
  else if (event.key === "]") setBrush(size * 1.25 + 0.5);
  else if (event.key === "-") setOpacity(Number($("opacity").value) - 10);
  else if (event.key === "+" || event.key === "=") setOpacity(Number($("opacity").value) + 10);
  else if (event.key === "s") { $("grow").checked = !$("grow").checked; grow(); }
  else if (event.key === "n" || event.key === "PageDown") go(1);
  else if (event.key === "p" || event.key === "PageUp") go(-1);
  else return;
  event.preventDefault();
});

$("size").addEventListener("input", () => setBrush($("size").value));
$("opacity").addEventListener("input", () => setOpacity($("opacity").value));
$("zoom").addEventListener("input", () => { $("zoom-text").textContent = `${$("zoom").value} %`; fit(); });
$("eraser").addEventListener("click", () => choose(session.ignore));
$("undo").addEventListener("click", undo);
$("grow").addEventListener("change", grow);
$("again").addEventListener("click", () => save());
$("previous").addEventListener("click", () => go(-1));
$("next").addEventListener("click", () => go(1));
$("number").addEventListener("change", () => {
  const wanted = Number($("number").value);
  if (!Number.isInteger(wanted) || wanted < 0 || wanted >= session.frames) { $("number").value = number; return; }
  if (session.order.includes(wanted)) at = session.order.indexOf(wanted);
  show(wanted);
});
addEventListener("resize", fit);

// ---- begin

async function begin() {
  try {
    session = await (await request("session")).json();
  } catch (error) {
    say(error.message, true);
    return;
  }
  document.title = `Label ${session.log}`;
  $("log").textContent = session.log;
  $("log").title = `saved to ${session.folder}`;
  $("number").max = session.frames - 1;
  listClasses();
  choose(session.classes[0].id);
  setOpacity(60);
  $("zoom-text").textContent = "100 %";
  const left = session.order.findIndex((n) => !session.labelled.includes(n));
  at = Math.max(left, 0);
  await show(session.order[at]);
  setBrush(image.width / 40);
}

begin();
