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
// Ends the session with the service, then shows the log-in page.
document.addEventListener("click", async (event) => {
  if (!event.target.closest("#log-out")) return;
  await fetch("/v1/session", { method: "DELETE" }).catch(() => undefined);
  location.assign("/login.html");
});
