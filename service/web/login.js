// Logs in with a key: the service answers with a cookie that scripts cannot read.
const line = document.querySelector("#login-line");
const field = document.querySelector("#key");

document.querySelector("#login").addEventListener("submit", async (event) => {
  event.preventDefault();
  line.textContent = "…";
  try {
    const body = JSON.stringify({ key: field.value.trim() });
    const response = await fetch("/v1/session", { method: "POST", headers: { "Content-Type": "application/json" }, body });
    if (response.ok) return location.assign(next());
    line.textContent = `${(await response.json()).detail}`;
  } catch {
    line.textContent = "The service does not answer.";
  }
  field.select();
});

// Returns the page that asked for the log-in; only pages of this service count.
function next() {
  const path = new URLSearchParams(location.search).get("next") || "/";
  return /^\/[a-z-]*(\.html)?$/.test(path) ? path : "/";
}
