// Learns the looks of a known panel from an overview that the arm drives to, or from the image.
import { FINAL, finished, get, post } from "./api.js";
import { isClear } from "./stop.js";

const $ = (selector) => document.querySelector(selector);

// `tell` shows progress and result as text, `show` the result object by object.
export function startLearn({ chosenImage, attempt, tell, show }) {
  let isLearning = false;
  const fromImage = () => ({ image: chosenImage(), panel: $("#known-panel").value });

  $("#looks-form").addEventListener("submit", (event) => {
    event.preventDefault();
    learn({});
  });
  $("#learn-image").addEventListener("click", () => learn(fromImage()));
  document.addEventListener("latch", enable);

  async function learn(body) {
    isLearning = true;
    enable();
    tell("Learning …");
    await attempt(async () => {
      const { result } = await followed(await post("/v1/learn", body));
      tell(words(result));
      await show(result, !body.image);
    });
    if ($("#saved").textContent.endsWith(" …")) tell("Nothing was learned.");
    isLearning = false;
    enable();
  }

  // Shows each step, because driving there takes some time.
  async function followed(task) {
    while (!FINAL.includes(task.state)) {
      if (task.step) tell(`${task.step} …`);
      task = await get(`/v1/tasks/${task.id}?wait_s=1`);
    }
    return finished(task);
  }

  function words({ panel, added, taught_by, known_before, known_now }) {
    const looks = Object.entries(added).map(([kind, number]) => `${kind.replaceAll("_", " ")} ${number}`);
    const fresh = looks.length ? `new looks: ${looks.join(", ")}` : "all of it was known already";
    return `Panel ${panel}: ${fresh}. Of ${taught_by.length} objects ${known_before.length} were recognised before, ${known_now.length} now.`;
  }

  function enable() {
    $("#learn-here").disabled = isLearning || !isClear();
    $("#learn-here").title = isClear() ? "Locates the cell's panel, drives to the overview and looks" : "The stop is latched: reset it first";
    $("#learn-image").disabled = isLearning || !chosenImage() || !$("#known-panel").value;
  }

  return {
    enable,
    offer: (names) => {
      const before = $("#known-panel").value;
      $("#known-panel").replaceChildren(...names.map((name) => new Option(name, name, false, name === before)));
      enable();
    },
  };
}
