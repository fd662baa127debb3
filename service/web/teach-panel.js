// Teaches a whole panel: its objects one after the other, each with the questions of its kind.
import { get } from "./api.js";

const $ = (selector) => document.querySelector(selector);
const KINDS = ["gauge", "panel_meter", "display", "lamp", "button", "toggle", "rotary", "slider", "lever", "handwheel", "mushroom"];
const POINTED = ["at_min", "at_max"]; // places that can be clicked on
const fields = () => [...$("#questions").querySelectorAll("[data-key]")];
const answerTo = (key) => fields().find((input) => input.dataset.key === key);

// `clicks()` returns the present clicks, `pointAt` waits for one more, `save` receives the finished lesson.
export function startPanel({ clicks, pointAt, save, attempt }) {
  let objects = [];
  let asked = 0;

  $("#object-kind").replaceChildren(...KINDS.map((kind) => new Option(kind.replaceAll("_", " "), kind)));
  $("#object-kind").addEventListener("change", () => attempt(ask));
  $("#add-object").addEventListener("click", add);
  $("#panel-form").addEventListener("submit", (event) => {
    event.preventDefault();
    save({ name: $("#panel-name").value, objects });
  });
  attempt(ask);

  async function ask() {
    const mine = ++asked;
    const kind = $("#object-kind").value;
    if (fields().length && $("#questions").dataset.kind === kind) return;
    const { questions } = await get(`/v1/knowledge/questions?kind=${kind}`);
    if (mine !== asked) return;
    const typed = fields().filter((input) => input.value !== input.dataset.offered);
    $("#questions").replaceChildren(...questions.map(field));
    $("#questions").dataset.kind = kind;
    typed.forEach(keep);
  }

  // Answers typed before the kind was changed are kept for the new questions, above all the name.
  function keep({ dataset, value }) {
    const input = answerTo(dataset.key);
    if (!input) return;
    input.value = value;
    if (input.value !== value) input.value = input.dataset.offered; // the old answer is not one of its choices
  }

  function field(question) {
    const label = document.createElement("label");
    const words = Object.assign(document.createElement("span"), { textContent: question.text });
    const input = question.choices.length ? document.createElement("select") : document.createElement("input");
    input.dataset.key = question.key;
    if (question.choices.length) input.append(...question.choices.map((choice) => new Option(choice, choice)));
    input.value = question.default;
    input.dataset.offered = input.value;
    label.append(words, POINTED.includes(question.key) ? pointable(input) : input);
    return label;
  }

  function pointable(input) {
    const box = Object.assign(document.createElement("span"), { className: "pointed" });
    const button = Object.assign(document.createElement("button"), { type: "button", textContent: "point" });
    const { key } = input.dataset; // the input may have been replaced before the click
    button.addEventListener("click", () => pointAt((x, y) => keep({ dataset: { key }, value: `${x.toFixed(1)},${y.toFixed(1)}` })));
    box.append(input, button);
    return box;
  }

  function add() {
    const answers = {};
    for (const input of fields()) answers[input.dataset.key] = input.value.trim();
    const { name, ...rest } = answers;
    if (!name) return attempt(() => Promise.reject(new Error("The object needs a name")));
    objects = [...objects.filter((one) => one.name !== name), { kind: $("#object-kind").value, name, clicks_px: clicks(), answers: rest }];
    list();
    $("#clear").click();
    $("#questions").replaceChildren();
    attempt(ask);
  }

  function list() {
    const rows = objects.map((one) => {
      const row = document.createElement("li");
      const words = Object.assign(document.createElement("span"), { textContent: `${one.name} · ${one.kind.replaceAll("_", " ")}` });
      const button = Object.assign(document.createElement("button"), { type: "button", textContent: "remove" });
      button.addEventListener("click", () => {
        objects = objects.filter((other) => other !== one);
        list();
      });
      row.append(words, button);
      return row;
    });
    $("#objects").replaceChildren(...rows);
    $("#save-panel").disabled = !objects.length;
  }

  return {
    enable: (hasOutline) => ($("#add-object").disabled = !hasOutline),
    suggest: (kind) => {
      if (!KINDS.includes(kind) || kind === $("#object-kind").value) return;
      $("#object-kind").value = kind;
      attempt(ask);
    },
  };
}
