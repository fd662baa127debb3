// The software stop, without any help of the console: it asks the stop process on its own port, and the service as well.
// The ports keep the distance that they have on the machine of the cell, so that it works through `ssh -L` of a whole
// range, through the plain ports, and on the machine itself. A page that came over TLS may not ask plain ports of other
// machines: it asks `/v1/stop` of its own address, which a proxy passes on to the service, without the console.
(() => {
  const box = document.querySelector("#stop-box");
  const line = document.querySelector("#stop-line");
  const reset = document.querySelector("#stop-reset");
  const words = JSON.parse(box.dataset.words);
  const here = Number(location.port || 80);
  const ports = new Set([here + Number(box.dataset.stopPort) - Number(box.dataset.ownPort), Number(box.dataset.stopPort)]);
  const isPlain = location.protocol === "http:";
  const plain = [...ports].filter((port) => port > 0 && port < 65536).map((port) => `http://${location.hostname}:${port}/v1/stop`);
  const ways = isPlain ? plain : ["/v1/stop"];
  const PATIENCE_MS = 3000;
  let count = 0;
  let shownMs = 0;
  let isDirect = false; // the stop process answered the page itself the last time; then the console is not asked as well
  let pending = 0; // presses that are not answered yet and could latch the stop again after a reset

  async function ask(url, method, body) {
    const options = { method, cache: "no-store", signal: AbortSignal.timeout(PATIENCE_MS) };
    if (body) Object.assign(options, { body: JSON.stringify(body), headers: { "Content-Type": "application/json" } });
    const answer = await fetch(url, options);
    if (!answer.ok) throw new Error((await answer.text()).trim());
    return answer.json();
  }

  function stop() {
    line.textContent = words.stopping;
    pending += 1;
    const askedMs = performance.now();
    const asked = [...ways, "/relay/stop"].map((url) => ask(url, "POST"));
    Promise.any(asked).then((state) => show(state, askedMs)).catch(() => tell("unknown", words.silent));
    Promise.allSettled(asked).then(() => { pending -= 1; return look(); });
  }

  async function look() {
    const askedMs = performance.now();
    const wasDirect = isDirect;
    const direct = Promise.any(ways.map((url) => ask(url, "GET")));
    direct.then(() => (isDirect = true), () => (isDirect = false));
    try {
      show(await (wasDirect ? direct : Promise.any([direct, ask("/relay/stop", "GET")])), askedMs);
    } catch {
      if (wasDirect) return look();
      tell("unknown", words.silent);
    }
  }

  function show(state, askedMs) {
    if (state.count < count && askedMs < shownMs) return; // an answer that was overtaken
    [count, shownMs] = [state.count, performance.now()];
    if (state.is_latched) tell("yes", `${words.stopped} · ${state.source}`);
    else tell("no", words.clear);
  }

  function tell(latched, text) {
    box.dataset.latched = latched;
    if (line.textContent !== text) line.textContent = text;
    reset.hidden = pending > 0 || latched !== "yes";
    document.dispatchEvent(new CustomEvent("latch"));
  }

  document.querySelector("#stop-button").addEventListener("click", stop);
  document.addEventListener("keydown", (event) => event.key === "Escape" && stop(), true);
  reset.addEventListener("click", () => ask("/relay/stop/reset", "POST", { seen_count: count }).then((state) => show(state, performance.now())).catch((error) => (line.textContent = error.message)));
  const again = () => (document.hidden ? Promise.resolve() : look()).finally(() => setTimeout(again, 1000));
  again();
})();
