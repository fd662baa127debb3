// The software stop: the button asks the stop process on its own port and the service at the same time.
import { get, post, repeat } from "./api.js";

const box = document.querySelector("#stop-box");
const line = document.querySelector("#stop-line");
const reset = document.querySelector("#reset");
const PATIENCE_MS = 5000; // after this time the slower of the two requests no longer delays a reset
let count = 0;
let shownMs = 0; // monotonic time of the shown state, because the count of a restarted service begins again
let stopping = 0; // presses with an unanswered request, which could latch the stop again after a reset

// `stopUrl` is a promise, so that the button works before the port of the stop process is known.
export function startStop(stopUrl) {
  const stop = () => {
    line.textContent = "stopping …";
    stopping += 1;
    const askedMs = performance.now();
    const known = Promise.race([stopUrl, after(PATIENCE_MS).then(() => Promise.reject(new Error("no port")))]); // a stop must not arrive late
    const asked = [known.then((url) => fetch(url, { method: "POST" })).then((answer) => answer.json()), post("/v1/stop")];
    Promise.any(asked).then((state) => show(state, askedMs)).catch(() => (line.textContent = "NO ANSWER: use the hardware stop"));
    const bothWays = Promise.allSettled(asked).then(look); // the slower request has increased the count again
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
