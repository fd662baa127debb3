// Starts the parts of the page and shows when the service cannot be reached.
import { get, insist, remove, repeat, toLogIn } from "./api.js";
import { startDevices } from "./devices.js";
import { startLive } from "./live.js";
import { startMission } from "./mission.js";
import { startStop } from "./stop.js";
import { startView } from "./view.js";

const banner = document.querySelector("#banner");

function describe(info) {
  const where = info.mode === "sim" ? "simulated" : info.mode === "mixed" ? "partly simulated" : "real";
  const link = document.querySelector("#console");
  link.hidden = !info.console_url;
  if (info.console_url) link.href = `http://${location.hostname}:${new URL(info.console_url).port}`;
  document.querySelector("#cell-line").textContent = `cell ${info.cell} · ${where} · panel ${info.panel} · seed ${info.seed}`;
}

// Shows who may use the service, and who uses it here.
async function showAccess() {
  const session = await get("/v1/session");
  const isOpen = session.access === "open";
  document.querySelector("#access-line").textContent = isOpen
    ? "No keys: every program of this computer may move the arm."
    : `Key ${session.name} (${session.role}).`;
  document.querySelector("#log-out").hidden = isOpen;
}

document.querySelector("#log-out").addEventListener("click", () => remove("/v1/session").then(() => location.assign("/login.html")));

async function watchService() {
  try {
    const response = toLogIn(await fetch("/readyz", { cache: "no-store" }));
    const ready = await response.json();
    const sick = ready.processes.find((process) => process.detail) || {};
    document.body.classList.remove("lost");
    banner.hidden = ready.is_ready;
    banner.textContent = ready.is_running
      ? `Without ${ready.missing.map((one) => `${one.device} (lost: ${one.lost.join(", ") || "its readings"})`).join("; ")}`
      : `The cell is not ready. ${sick.detail || "It is starting."}`;
  } catch {
    document.body.classList.add("lost"); // the page shows the last known state
    banner.hidden = false;
    banner.textContent = "The service does not answer. Is panelwright serve still running?";
  }
}

const asked = insist("/v1/info");
startStop(asked.then((info) => info.stop_url));
repeat(watchService, () => 2000);
const info = await asked;
describe(info);
showAccess().catch(() => {});
startMission(info.verbs);
startDevices();
startView();
startLive();
