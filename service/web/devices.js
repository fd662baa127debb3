// Shows the health of all devices.
import { get, post, repeat } from "./api.js";

const connecting = new Set(); // names of the devices that are being connected
const trouble = new Map(); // error of the newest attempt, by device

export function startDevices() {
  repeat(list, () => 2000);
}

async function list() {
  const { devices } = await get("/v1/devices").catch((lost) => {
    document.querySelector("#devices-line").textContent = "not known now";
    throw lost;
  });
  const good = devices.filter((device) => device.health.connected && device.health.quality === "valid").length;
  document.querySelector("#devices-line").textContent = `${good} of ${devices.length} good`;
  document.querySelector("#devices").replaceChildren(...devices.map(item));
}

function item(device) {
  const { health } = device;
  const quality = health.connected ? health.quality : "invalid";
  const line = document.createElement("li");
  const dot = document.createElement("span");
  dot.className = "dot";
  dot.dataset.quality = quality;
  const name = document.createElement("span");
  name.textContent = device.name;
  name.title = `${device.kind} by ${device.driver}`;
  const words = document.createElement("span");
  words.className = "quiet right";
  const cause = health.cause === "none" ? "" : ` (${health.cause})`;
  words.textContent = health.connected ? `${quality}${cause} · ${health.samples} ${health.samples === 1 ? "sample" : "samples"}` : "disconnected";
  words.title = health.detail;
  line.append(dot, name, words);
  if (!health.connected) line.append(...remedy(device));
  return line;
}

// Shows why a device is missing, and a button to connect it again.
function remedy(device) {
  const why = document.createElement("span");
  why.className = "quiet why";
  why.textContent = trouble.get(device.name) || device.health.detail;
  const again = document.createElement("button");
  again.textContent = "connect";
  again.setAttribute("aria-label", `connect ${device.name}`);
  again.disabled = connecting.has(device.name);
  again.addEventListener("click", () => connect(device.name));
  return [why, again];
}

async function connect(name) {
  connecting.add(name);
  trouble.set(name, "connecting…");
  await list();
  try {
    await post(`/v1/devices/${name}/connect`);
    trouble.delete(name);
  } catch (problem) {
    trouble.set(name, `${problem.message}. ${problem.hint}`);
  }
  connecting.delete(name);
  await list();
}
