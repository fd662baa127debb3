// The image to click on (uploaded, stored, or taken by a camera of the cell) with its clicks and the outline over it.
import { ProblemError, ask, get, upload } from "./api.js";

const MOST_CLICKS = 3;
const WAYS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const STEPS = 80; // steps of the keyboard's cross over the width of the image
const SVG = "http://www.w3.org/2000/svg";
const $ = (selector) => document.querySelector(selector);
const picture = $("#picture");
let image = null; // the stored image that is shown
let points = [];
let cross = null; // where the keyboard would click, px
let pointed = null; // function that receives the next click instead of the outline
let isElsewhere = false; // whether a picture of another image is shown, on which clicks have no meaning
let listeners = [];

export const chosenImage = () => image && image.id;
export const clicks = () => points;
export const onClicks = (listener) => listeners.push(listener);

// The next click goes to `taker(x, y)`: the end of a scale, for example.
export function pointAt(taker) {
  pointed = taker;
  $("#canvas").dataset.pointing = taker ? "yes" : "no";
}

export async function startImage({ attempt, changed }) {
  const keep = (data) => attempt(async () => {
    show(await upload("/v1/images", data));
    changed();
    await list();
  });
  $("#file").addEventListener("change", (event) => event.target.files[0] && keep(event.target.files[0]));
  $("#stored").addEventListener("change", (event) => attempt(async () => {
    const { images } = await get("/v1/images");
    const found = images.find((one) => one.id === event.target.value);
    if (found) show(found);
    changed();
  }));
  $("#canvas").addEventListener("click", click);
  $("#canvas").addEventListener("keydown", steer);
  $("#clear").addEventListener("click", clear);
  await attempt(async () => {
    await list();
    const { devices } = await get("/v1/devices");
    const cameras = devices.filter((device) => device.kind === "camera");
    $("#cameras").replaceChildren(...cameras.map((camera) => taker(camera.name, keep, attempt)));
  });
}

function taker(name, keep, attempt) {
  const button = document.createElement("button");
  button.textContent = `Take from ${name.replaceAll("_", " ")}`;
  button.addEventListener("click", () => attempt(async () => {
    const answer = await ask(`/v1/devices/${name}/reading?format=png`, { cache: "no-store" });
    if (!answer.ok) throw new ProblemError(await answer.json(), answer.status);
    await keep(await answer.blob());
  }));
  return button;
}

async function list() {
  const { images } = await get("/v1/images");
  const options = images.map((one) => {
    const when = new Date(1000 * one.stored_s).toLocaleString();
    return new Option(`${one.width_px} × ${one.height_px} · ${when}`, one.id, false, image !== null && one.id === image.id);
  });
  $("#stored").replaceChildren(new Option("stored images …", ""), ...options);
}

function show(stored) {
  image = stored;
  cross = null;
  $("#cross").hidden = true;
  $("#canvas").dataset.empty = "no";
  $("#image-line").textContent = `${stored.width_px} × ${stored.height_px} px`;
  clear();
}

function clear() {
  points = [];
  pointAt(null);
  $("#clear").disabled = true;
  showPicture(null);
  tell();
}

function click(event) {
  if (!image) return;
  const box = picture.getBoundingClientRect();
  const x = ((event.clientX - box.left) / box.width) * image.width_px - 0.5;
  const y = ((event.clientY - box.top) / box.height) * image.height_px - 0.5;
  pick(x, y);
}

// Without a mouse, arrow keys move a cross (with Shift by one pixel), and Enter clicks there.
function steer(event) {
  const way = WAYS[event.key];
  if (!image || (!way && event.key !== "Enter")) return;
  event.preventDefault(); // arrows would scroll
  const size = [image.width_px, image.height_px];
  cross ??= size.map((length) => Math.round(length / 2));
  const step = event.shiftKey ? 1 : Math.round(image.width_px / STEPS);
  if (way) cross = cross.map((at, axis) => Math.min(Math.max(at + step * way[axis], 0), size[axis] - 1));
  else pick(...cross);
  $("#cross").hidden = false;
  [$("#cross").style.left, $("#cross").style.top] = cross.map((at, axis) => `${(100 * (at + 0.5)) / size[axis]}%`);
}

function pick(x, y) {
  if (isElsewhere) return showPicture(null);
  if (pointed) {
    pointed(x, y);
    return pointAt(null);
  }
  points = points.length >= MOST_CLICKS ? [[x, y]] : [...points, [x, y]]; // a fourth click starts again
  $("#clear").disabled = false;
  showPicture(null);
  tell();
}

const tell = () => listeners.forEach((listener) => listener(points));

// Shows the stored image (or `url` in its place, `elsewhere` when it is not of that image) with the clicks and an outline.
export function showPicture(outline, url = image && image.url, elsewhere = false) {
  if (!url) return;
  isElsewhere = elsewhere;
  if (!picture.src.endsWith(url)) picture.src = url;
  const marks = $("#marks");
  $("#canvas").dataset.empty = "no";
  if (!image) return marks.replaceChildren();
  marks.setAttribute("viewBox", `-0.5 -0.5 ${image.width_px} ${image.height_px}`);
  const unit = image.width_px / 800;
  const shapes = points.map(([x, y]) => shape("path", { d: `M${x - 7 * unit} ${y}h${14 * unit}M${x} ${y - 7 * unit}v${14 * unit}`, stroke: "#e8b04b" }, unit));
  if (outline) shapes.unshift(shape("polygon", { points: outline.map((p) => p.join(",")).join(" "), stroke: "#4fb3bf", id: "outline" }, unit));
  marks.replaceChildren(...(url === image.url ? shapes : []));
}

function shape(name, attributes, unit) {
  const node = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries({ ...attributes, fill: "none", "stroke-width": 2 * unit })) node.setAttribute(key, value);
  return node;
}
