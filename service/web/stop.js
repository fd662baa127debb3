// The software stop: the button talks to the stop process on its own port, and to the service as well, whichever is faster.
import { get, post, repeat } from "./api.js";

const box = document.querySelector("#stop-box");
const line = document.querySelector("#stop-line");
const reset = document.querySelector("#reset");
const PATIENCE_MS = 5000; // after this the slower way to stop no longer delays a reset
let count = 0;
let shownMs = 0; // since when, by a clock that nobody sets: a service that was started anew counts from the beginning
let stopping = 0; // presses of which one way is still under way: it would latch again what was reset before it arrives

// `stopUrl` is a promise: the button works from the first moment, and the stop process is told once its port is known.
export function startStop(stopUrl) {
  const stop = () => {
    line.textContent = "stopping …";
    stopping += 1;
    const askedMs = performance.now();
    const known = Promise.race([stopUrl, after(PATIENCE_MS).then(() => Promise.reject(new Error("no port")))]); // never a late stop
    const asked = [known.then((url) => fetch(url, { method: "POST" })).then((answer) => answer.json()), post("/v1/stop")];
    Promise.any(asked).then((state) => show(state, askedMs)).catch(() => (line.textContent = "NO ANSWER: use the hardware stop"));
    const bothWays = Promise.allSettled(asked).then(look); // the slower of the two has raised the count again
    Promise.race([bothWays, after(PATIENCE_MS)]).catch(() => {}).then(allowReset);
  };
  document.querySelector("#stop").addEventListener("click", stop);
  document.addEventListener("keydown", (event) => event.key === "Escape" && stop());
  reset.addEventListener("click", async () => {
    const askedMs = performance.now();
    try {
      show(await post("/v1/stop/reset", { seen_count: count }), askedMs);
    } catch (error) {
      line.textContent = `${error.message}. ${error.hint || ""}`;
    }
  });
  repeat(look, () => 1000);
}

export const isLatched = () => box.dataset.latched === "yes";
export const isClear = () => box.dataset.latched === "no";

const after = (ms) => new Promise((done) => setTimeout(done, ms));

function allowReset() {
  stopping -= 1;
  reset.hidden = stopping > 0 || !isLatched();
}

async function look() {
  const askedMs = performance.now();
  try {
    show(await get("/v1/stop"), askedMs);
  } catch {
    tell("unknown", "NO ANSWER: use the hardware stop");
  }
}

function show(state, askedMs) {
  if (state.count < count && askedMs < shownMs) return; // an answer that was overtaken
  [count, shownMs] = [state.count, performance.now()];
  if (state.is_latched) tell("yes", `STOPPED · ${state.source}`);
  else tell("no", "clear to move");
}

function tell(latched, words) {
  box.dataset.latched = latched;
  line.textContent = words;
  reset.hidden = stopping > 0 || latched !== "yes";
  document.dispatchEvent(new CustomEvent("latch"));
}
