// Health of all devices.
import { get, repeat } from "./api.js";

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
  return line;
}
