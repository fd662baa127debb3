// The teach page: choose an image, click on an object, see its outline, name it, save it, and check what is recognised.
import { finished, get, insist, post, remove } from "./api.js";
import { startLearn } from "./teach-learn.js";
import { startStop } from "./stop.js";
import { chosenImage, clicks, onClicks, pointAt, showPicture, startImage } from "./teach-image.js";
import { startPanel } from "./teach-panel.js";

const $ = (selector) => document.querySelector(selector);
let outline = null; // what was found at the present clicks
let lastPanel = null; // the panel that was saved last, which the check reads
const MODES = ["kind", "panel", "looks"];
let asked = 0; // number of requests; only the answer to the newest one is shown

const plate = () => [Number($("#plate-width").value), Number($("#plate-height").value)];
const base = () => ({ image: chosenImage(), plate_m: plate() });

async function look(points) {
  const mine = ++asked;
  outline = null;
  enable();
  if (!points.length) return say("Nothing clicked on yet.");
  say("Looking …");
  try {
    const found = await post("/v1/knowledge/outline", { ...base(), clicks_px: points });
    if (mine !== asked) return;
    outline = found;
    say(words(found));
    if (found.taken_for && !$("#kind").value) $("#kind").value = found.taken_for;
    panel.suggest(found.taken_for);
  } catch (error) {
    if (mine === asked) say(`${error.message}: ${error.hint || ""}`, true);
  }
  showPicture(outline ? outline.outline_px : null);
  enable();
}

function words(found) {
  const [width, height] = found.size_m.map((side) => Math.round(1000 * side));
  const what = found.shape === "clicks" ? "No outline but edges inside your clicks" : `Found a ${found.shape}`;
  const sure = found.reason ? `, though ${found.reason}` : ` (${found.confidence?.toFixed(2)})`;
  const name = found.taken_for ? `Recognised as ${found.taken_for.replaceAll("_", " ")}${sure}.` : "No known kind looks like it.";
  return `${what}, ${width} × ${height} mm. ${name}`;
}

function say(text, isBad = false) {
  $("#found").textContent = text;
  $("#found").classList.toggle("bad", isBad);
}

function enable() {
  $("#teach-kind").disabled = !outline;
  $("#check").disabled = !chosenImage();
  for (const mode of MODES) $(`#${mode}-form`).hidden = $(`#mode-${mode}`).ariaPressed !== "true";
  panel.enable(outline !== null);
  learn.enable();
}

async function teachKind(event) {
  event.preventDefault();
  await attempt(async () => {
    const taught = await post("/v1/knowledge/teach", { ...base(), kind: $("#kind").value, clicks_px: clicks() });
    const kind = taught.name.replaceAll("_", " ");
    tell(taught.added ? `Taught ${taught.is_new ? "the new kind" : "a further"} ${kind}: ${taught.path}` : `This ${kind} was known already: nothing was written.`);
    lastPanel = null;
    $("#kind-form").reset();
    await listKnown();
    await check();
  });
}

async function savePanel(lesson) {
  await attempt(async () => {
    const taught = await post("/v1/knowledge/teach", { ...base(), panel: lesson });
    tell(`Saved panel ${taught.name}: ${taught.path}${taught.lights_are_seen ? "" : ". Its border lights were not seen: measure them."}`);
    lastPanel = taught.name;
    await listKnown();
    await check();
  });
}

async function check() {
  await attempt(async () => {
    $("#results").replaceChildren(line("looking …"));
    const verb = lastPanel ? "inspect" : "recognise";
    const body = lastPanel ? { image: chosenImage(), panel: lastPanel } : { ...base(), mode: "blind" };
    const task = await finished(await post(`/v1/${verb}`, body));
    const rows = lastPanel ? task.result.objects.map(reading) : task.result.candidates.filter((c) => !c.reason).map(candidate);
    const refused = lastPanel ? 0 : task.result.candidates.length - rows.length;
    if (refused) rows.push(line(`${count(refused, "more place", "more places")} refused: not sure enough`));
    $("#results").replaceChildren(...(rows.length ? rows : [line("nothing that is known")]));
    showPicture(null, task.result.pictures[0]);
    $("#show-plain").hidden = false;
  });
}

function candidate(found) {
  return pair(found.kind.replaceAll("_", " "), `${found.confidence.toFixed(2)} at ${found.centre_px.map(Math.round).join(", ")}`);
}

function reading(row) {
  const value = row.text ?? row.state ?? (row.value === null ? null : row.value.toPrecision(4));
  const item = pair(`${row.name} · ${row.kind.replaceAll("_", " ")}`, row.reason ? "cannot tell" : `${value} ${row.unit || ""}`);
  if (row.reason) item.append(Object.assign(document.createElement("span"), { className: "refused", textContent: row.reason }));
  return item;
}

async function listKnown() {
  const known = await get("/v1/knowledge?toml=false");
  const taught = [...known.panels.filter((p) => p.is_taught).map((p) => ["panels", p.name, `panel, ${count(p.objects.length, "object")}`]),
    ...known.kinds.filter((k) => k.is_taught).map((k) => ["kinds", k.name, `kind, ${count(k.looks, "look")}`])];
  const kinds = known.kinds.map((kind) => kind.name).filter((name) => name !== "nothing");
  learn.offer(known.panels.map((one) => one.name));
  $("#kinds").replaceChildren(...kinds.map((name) => Object.assign(document.createElement("option"), { value: name })));
  $("#known-line").textContent = [count(kinds.length, "kind"), count(known.panels.length, "panel"), count(known.objects.length, "object")].join(" · ");
  $("#known").replaceChildren(...(taught.length ? taught.map(forgettable) : [line("Nothing taught here yet; shipped kinds only.")]));
}

function forgettable([group, name, what]) {
  const item = pair(`${name} · ${what}`, "");
  const button = Object.assign(document.createElement("button"), { textContent: "forget" });
  button.addEventListener("click", () => attempt(async () => {
    await remove(`/v1/knowledge/${group}/${name}`);
    if (lastPanel === name) lastPanel = null;
    await listKnown();
  }));
  item.lastChild.replaceWith(button);
  return item;
}

function pair(left, right) {
  const item = document.createElement("li");
  item.append(...[left, right].map((text) => Object.assign(document.createElement("span"), { textContent: text })));
  return item;
}

const count = (number, one, many = `${one}s`) => `${number} ${number === 1 ? one : many}`;
const line = (text) => Object.assign(document.createElement("li"), { className: "quiet", textContent: text });

function tell(text) {
  $("#saved").hidden = false;
  $("#saved").textContent = text;
}

async function attempt(work) {
  $("#complaint").hidden = true;
  try {
    await work();
  } catch (error) {
    $("#complaint").hidden = false;
    $("#complaint").textContent = `${error.message}. ${error.hint || ""}`;
    if ($("#results").textContent === "looking …") $("#results").replaceChildren(line("see above"));
  }
}

// Shows what was learned from a known panel, object by object, as the check does.
async function showLearned(result, isLive) {
  const rows = result.taught_by.map((name) => pair(name, result.known_now.includes(name) ? "recognised now" : "not recognised yet"));
  rows.push(...Object.entries(result.left_out).map(([name, why]) => {
    const item = pair(name, "nothing learned");
    item.append(Object.assign(document.createElement("span"), { className: "refused", textContent: why }));
    return item;
  }));
  $("#results").replaceChildren(...rows);
  showPicture(null, result.pictures[0], isLive);
  $("#show-plain").hidden = !chosenImage();
  await listKnown();
}

function choose(mode) {
  for (const name of MODES) $(`#mode-${name}`).ariaPressed = String(name === mode);
  enable();
}

if ($("#stop")) startStop(insist("/v1/info").then((info) => info.stop_url)); // the console has a stop of its own
const panel = startPanel({ clicks, pointAt, save: savePanel, attempt });
const learn = startLearn({ chosenImage, attempt, tell, show: showLearned });
onClicks(look);
startImage({ attempt, changed: enable });
$("#kind-form").addEventListener("submit", teachKind);
$("#check").addEventListener("click", check);
$("#show-plain").addEventListener("click", () => {
  showPicture(outline ? outline.outline_px : null);
  $("#show-plain").hidden = true;
});
for (const mode of MODES) $(`#mode-${mode}`).addEventListener("click", () => choose(mode));
enable();
attempt(listKnown);
