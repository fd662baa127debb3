// Shows joints, force and contacts from the WebSocket stream.

const live = document.querySelector("#live");
const joints = document.querySelector("#joints");
const chip = document.querySelector("#live-state");
const DRAW_MS = 100;
let newest = null;

export function startLive() {
  connect();
  setInterval(() => !document.hidden && newest && draw(newest), DRAW_MS);
}

function connect() {
  const socket = new WebSocket(`${location.protocol.replace("http", "ws")}//${location.host}/v1/stream`);
  socket.onmessage = (message) => (newest = JSON.parse(message.data));
  socket.onclose = () => {
    newest = null;
    showState("no stream", "failed");
    setTimeout(connect, 2000);
  };
}

function draw(state) {
  if (!state.position_rad) return showWhyNot(state.problem || "no arm");
  const isStale = state.faults.length > 0; // the values are those of the device's last answer
  live.classList.toggle("stale", isStale);
  joints.classList.toggle("stale", isStale);
  chip.title = state.faults.join("; ");
  if (isStale) showState(`stale: ${state.faults.map((fault) => fault.split(":")[0]).join(", ")}`, "failed");
  else if (state.is_latched) showState("stopped", "stopped");
  else showState(state.is_moving ? "moving" : "at rest", state.is_moving ? "moving" : "ready");
  const [x, y, z] = state.base_from_flange.translation_m;
  const force = Math.hypot(...state.wrench.slice(0, 3));
  const near = state.proximity_m.filter((value) => value !== null);
  const facts = {
    "flange x · y · z": `${mm(x)} ${mm(y)} ${mm(z)} mm`,
    "contact force": `${force.toFixed(1)} N`,
    gripper: `${mm(state.gripper_width_m)} mm`,
    contacts: state.contacts.map((on) => (on ? "●" : "○")).join(" ") || "–",
    proximity: near.length ? `${near.map(mm).join(" · ")} mm` : "nothing near",
    "cell time": `${state.stamp_s.toFixed(1)} s`,
  };
  live.replaceChildren(...Object.entries(facts).map(fact));
  joints.replaceChildren(...state.position_rad.map(joint));
}

// Shows as text why there is no state, for example because a device is missing.
function showWhyNot(problem) {
  showState("no state", "failed");
  const why = document.createElement("p");
  why.className = "quiet";
  why.textContent = problem;
  live.replaceChildren(why);
  live.classList.remove("stale");
  joints.replaceChildren();
}

function showState(words, state) {
  chip.textContent = words;
  chip.dataset.state = state;
}

function fact([name, value]) {
  const box = document.createElement("div");
  const term = document.createElement("dt");
  const words = document.createElement("dd");
  term.textContent = name;
  words.textContent = value;
  box.append(term, words);
  return box;
}

function joint(angle, index) {
  const row = document.createElement("div");
  row.className = "joint";
  const name = document.createElement("span");
  name.textContent = `J${index + 1}`;
  const bar = document.createElement("span");
  bar.className = "bar";
  const mark = document.createElement("i");
  mark.style.left = `${50 + 50 * Math.max(-1, Math.min(1, angle / (2 * Math.PI)))}%`;
  bar.append(mark);
  const value = document.createElement("b");
  value.textContent = `${((180 * angle) / Math.PI).toFixed(1)}°`;
  row.append(name, bar, value);
  return row;
}

const mm = (metres) => (metres === null ? "–" : (1000 * metres).toFixed(1).replace(/^-0\.0$/, "0.0"));
