// Starts missions, follows the running task by server-sent events, lists tasks, links the last report.
import { FINAL, get, post, repeat } from "./api.js";
import { isClear, isLatched } from "./stop.js";

const $ = (selector) => document.querySelector(selector);
let followed = null; // id of the task whose events are shown
let isActive = false;
let canRun = false;

export function startMission(verbs) {
  canRun = verbs.includes("missions");
  $("#start").addEventListener("click", run);
  $("#cancel").addEventListener("click", () => post(`/v1/tasks/${followed}/cancel`).catch(complain));
  document.addEventListener("latch", enable);
  repeat(listTasks, () => (isActive ? 1000 : 2000));
  repeat(findReport, () => 4000);
  repeat(showLease, () => 3000);
}

async function run() {
  $("#start").disabled = true;
  try {
    follow(await post("/v1/missions", {}));
  } catch (error) {
    complain(error);
  }
  enable();
}

function enable() {
  $("#start").disabled = !canRun || isActive || !isClear();
  $("#start").title = isLatched() ? "The stop is latched: reset it first" : "";
}

function follow(task) {
  followed = task.id;
  isActive = !FINAL.includes(task.state);
  $("#steps").replaceChildren();
  showState(task.state, task.fraction);
  const events = new EventSource(task.events_url); // resumes by itself with Last-Event-ID
  const show = (message) => {
    const event = JSON.parse(message.data);
    if (followed !== task.id) return events.close();
    showState(event.state, event.fraction);
    if (event.kind === "progress") addStep(event.time_s, event.step, event.detail);
    if (!FINAL.includes(event.state)) return;
    events.close();
    isActive = false;
    if (event.detail) addStep(event.time_s, event.state, event.detail, "bad");
    if (event.state === "failed") get(`/v1/tasks/${task.id}`).then((ended) => addStep(event.time_s, "try", ended.problem.hint)).catch(() => {});
    enable();
    findReport().catch(() => {});
  };
  for (const kind of ["state", "progress"]) events.addEventListener(kind, show);
}

function showState(state, fraction) {
  const chip = $("#mission-state");
  chip.dataset.state = state;
  chip.textContent = state;
  $("#progress").value = fraction;
  $("#cancel").hidden = FINAL.includes(state) || state === "cancelling";
}

function addStep(timeS, step, detail, kind = "") {
  const item = document.createElement("li");
  const time = document.createElement("time");
  time.textContent = clock(timeS);
  const words = document.createElement("span");
  words.className = kind;
  words.textContent = step;
  const more = document.createElement("span");
  more.className = "detail";
  more.textContent = detail ? ` · ${detail}` : "";
  words.append(more);
  item.append(time, words);
  $("#steps").append(item);
  $("#steps").scrollTop = $("#steps").scrollHeight;
}

async function listTasks() {
  const { tasks } = await get("/v1/tasks?limit=8");
  const active = tasks.find((task) => !FINAL.includes(task.state));
  if (active && active.id !== followed) follow(active); // another client started it
  if (!active) isActive = false;
  enable();
  if (tasks.length) $("#tasks").replaceChildren(...tasks.map(row));
}

function row(task) {
  const line = document.createElement("tr");
  const chip = document.createElement("span");
  chip.className = "chip";
  chip.dataset.state = task.state;
  chip.textContent = task.state;
  const ended = task.ended_s || Date.now() / 1000;
  const took = task.started_s ? `${(ended - task.started_s).toFixed(1)} s` : "–";
  const step = task.problem ? task.problem.detail : task.step;
  const cells = [task.verb, chip, `${Math.round(100 * task.fraction)} %`, step || "–", clock(task.created_s), took];
  for (const cell of cells) {
    const box = document.createElement("td");
    box.append(cell);
    line.append(box);
  }
  line.children[3].className = "step";
  if (task.problem) line.children[3].append(Object.assign(document.createElement("p"), { className: "quiet", textContent: task.problem.hint }));
  return line;
}

async function findReport() {
  const { missions } = await get("/v1/missions");
  const last = missions.find((mission) => mission.report_url);
  $("#report").hidden = !last;
  if (last) $("#report").href = last.report_url;
}

async function showLease() {
  const lease = await get("/v1/lease");
  $("#lease-line").textContent = lease.is_held ? `the cell is held by ${lease.holder}` : "";
}

function complain(error) {
  addStep(Date.now() / 1000, error.message, error.hint || "", "bad");
}

const clock = (seconds) => new Date(1000 * seconds).toTimeString().slice(0, 8);
