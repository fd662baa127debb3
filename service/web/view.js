// Shows the live picture, requested only while the page is visible and less often while a task runs.
import { ProblemError, ask, get, repeat } from "./api.js";

const picture = document.querySelector("#picture");
const line = document.querySelector("#picture-line");
const choices = document.querySelector("#view-choices");
let chosen = null;
let isSeen = true;

export async function startView() {
  const { devices } = await get("/v1/devices");
  const eyes = devices.filter((device) => ["camera", "range_scanner"].includes(device.kind));
  choices.replaceChildren(...eyes.map(button));
  choose(eyes.length ? eyes[0].name : null);
  new IntersectionObserver((entries) => (isSeen = entries[0].isIntersecting)).observe(picture);
  repeat(show, () => (document.querySelector("#mission-state").dataset.state === "running" ? 1500 : 700));
}

function button(device) {
  const choice = document.createElement("button");
  choice.textContent = device.name.replaceAll("_", " ");
  choice.dataset.name = device.name;
  choice.addEventListener("click", () => choose(device.name));
  return choice;
}

function choose(name) {
  chosen = name;
  for (const choice of choices.children) choice.setAttribute("aria-pressed", String(choice.dataset.name === name));
  if (!name) line.textContent = "this cell has no camera";
}

async function show() {
  if (!chosen || !isSeen) return;
  const name = chosen;
  try {
    const response = await ask(`/v1/devices/${name}/reading?format=png&max_age_s=0.5`, { cache: "no-store" });
    if (name !== chosen) return;
    if (!response.ok) throw new ProblemError(await response.json(), response.status);
    draw(name, await response.blob());
  } catch (problem) {
    line.textContent = `${problem.message} · ${problem.hint || ""}`;
    picture.style.opacity = 0.35; // marks an old picture as such
  }
}

function draw(name, blob) {
  const old = picture.src;
  picture.src = URL.createObjectURL(blob);
  picture.style.opacity = 1;
  if (old.startsWith("blob:")) URL.revokeObjectURL(old);
  line.textContent = `${name} · ${new Date().toTimeString().slice(0, 8)}`;
}
