// Renews each live picture while it is seen; a picture that is not renewed is dimmed, so that an old one does not pass for new.
(() => {
  const PAUSE_MS = 1000;
  async function renew(picture) {
    const line = document.getElementById(picture.dataset.line);
    try {
      const answer = await fetch(picture.dataset.source, { cache: "no-store", signal: AbortSignal.timeout(10000) });
      if (!answer.ok) throw new Error((await answer.text()).trim());
      const old = picture.src;
      picture.src = URL.createObjectURL(await answer.blob());
      if (old.startsWith("blob:")) URL.revokeObjectURL(old);
      picture.classList.remove("stale");
      if (line) line.textContent = `${picture.dataset.name} · ${new Date().toTimeString().slice(0, 8)}`;
    } catch (error) {
      picture.classList.add("stale");
      if (line) line.textContent = `${picture.dataset.name} · ${error.message}`;
    }
  }
  async function loop() {
    const seen = document.hidden ? [] : [...document.querySelectorAll("img[data-source]")];
    await Promise.all(seen.map(renew));
    setTimeout(loop, seen.length ? PAUSE_MS : 200);
  }
  loop();
})();
// Shows how old each value is by the cell's clock, and dims what has not been read for a long time.
(() => {
  const box = document.querySelector("#stop-box");
  const aheadS = Number(box.dataset.utc) - Date.now() / 1000;
  const staleS = Number(box.dataset.staleS);
  const words = (s) => (s < 90 ? `${Math.round(s)} s` : s < 5400 ? `${Math.round(s / 60)} min` : s < 172800 ? `${Math.round(s / 3600)} h` : `${Math.round(s / 86400)} days`);
  setInterval(() => {
    const nowS = Date.now() / 1000 + aheadS;
    for (const one of document.querySelectorAll("time[data-utc]")) {
      const text = words(Math.max(0, nowS - Number(one.dataset.utc)));
      if (one.textContent !== text) one.textContent = text;
    }
    for (const one of document.querySelectorAll("[data-row]")) one.classList.toggle("old", nowS - Number(one.dataset.row) > staleS);
  }, 500);
})();
// Draws the cell in 3-D anew only where a message or the camera may have changed it; drawing it all the time takes half a processor.
// A drawing that takes long, for example without a graphics card, is followed by a pause of about three times its length: messages come first.
(() => {
  const AFTER_MESSAGE_MS = 300, AT_LEAST_EVERY_MS = 5000, FRAME_MS = 50;
  const thrifty = new WeakSet();
  let messageMs = 0;
  function spare(renderer) {
    const draw = renderer.render.bind(renderer), graphics = renderer.getContext();
    let drawnMs = -AT_LEAST_EVERY_MS, drawnView = "", fence = null, freeMs = 0;
    function isBusy(nowMs) {
      if (fence === null) return nowMs < freeMs;
      if (graphics.getSyncParameter(fence, graphics.SYNC_STATUS) !== graphics.SIGNALED) return !graphics.isContextLost();
      graphics.deleteSync(fence);
      fence = null;
      freeMs = nowMs + 3 * (nowMs - drawnMs - FRAME_MS);
      return nowMs < freeMs;
    }
    renderer.render = (things, camera) => {
      const nowMs = performance.now();
      const view = [...camera.position, ...camera.quaternion, ...camera.projectionMatrix.elements].join();
      const isSame = view === drawnView && nowMs > messageMs + AFTER_MESSAGE_MS;
      if (isBusy(nowMs) || (isSame && nowMs < drawnMs + AT_LEAST_EVERY_MS)) return;
      draw(things, camera);
      fence = graphics.fenceSync(graphics.SYNC_GPU_COMMANDS_COMPLETE, 0);
      graphics.flush();
      [drawnMs, drawnView] = [nowMs, view];
    };
    thrifty.add(renderer);
  }
  function look() {
    for (const box of document.querySelectorAll(".scene")) {
      const renderer = window.getElement(Number(box.id.slice(1)))?.renderer;
      if (!renderer || thrifty.has(renderer)) continue;
      if (messageMs === 0) window.socket.onAny(() => (messageMs = performance.now()));
      messageMs = performance.now();
      spare(renderer);
    }
  }
  setInterval(look, 500);
})();
// Ends the session with the service, then shows the log-in page.
document.addEventListener("click", async (event) => {
  if (!event.target.closest("#log-out")) return;
  await fetch("/v1/session", { method: "DELETE" }).catch(() => undefined);
  location.assign("/login.html");
});
