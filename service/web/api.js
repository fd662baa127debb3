// Calls the HTTP API. A problem (RFC 9457) becomes an Error with a readable message.

export const FINAL = ["succeeded", "failed", "cancelled"]; // states of a task that has ended

export class ProblemError extends Error {
  constructor(problem, status) {
    super(problem.detail || `the service answered ${status}`);
    this.hint = problem.hint || "";
    this.status = status;
    this.problem = problem;
  }
}

// Replaces a browser's "Failed to fetch", which does not say what to do.
export async function ask(path, options) {
  try {
    return toLogIn(await fetch(path, options));
  } catch {
    throw new ProblemError({ detail: "The service does not answer", hint: "Is panelwright serve still running?" }, 0);
  }
}

// A service with keys answers 401 before the browser has logged in, or after its session has ended.
export function toLogIn(response) {
  if (response.status === 401) location.assign(`/login.html?next=${encodeURIComponent(location.pathname)}`);
  return response;
}

export async function get(path) {
  return answered(await ask(path, { cache: "no-store" }));
}

// Repeats a GET request until there is an answer, for data that the page needs.
export async function insist(path) {
  for (;;) {
    try {
      return await get(path);
    } catch {
      await new Promise((done) => setTimeout(done, 1000));
    }
  }
}

export async function post(path, body) {
  const json = body === undefined ? {} : { headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) };
  return answered(await ask(path, { method: "POST", ...json }));
}

// Sends a file unchanged, with its own media type.
export async function upload(path, data) {
  return answered(await ask(path, { method: "POST", headers: { "Content-Type": data.type }, body: data }));
}

export async function remove(path) {
  return answered(await ask(path, { method: "DELETE" }));
}

// Waits for the task and returns it if it has succeeded; a failed task becomes an Error.
export async function finished(task) {
  while (!FINAL.includes(task.state)) task = await get(`/v1/tasks/${task.id}?wait_s=10`);
  if (task.state !== "succeeded") throw new ProblemError(task.problem || { detail: `the task was ${task.state}` }, 409);
  return task;
}

async function answered(response) {
  const data = await response.json().catch(() => ({}));
  if (!response.ok) throw new ProblemError(data, response.status);
  return data;
}

// Calls `work` again and again, `pause()` ms after it ended, and only while the page is visible.
export function repeat(work, pause) {
  const loop = async () => {
    if (!document.hidden) await work().catch(() => {});
    setTimeout(loop, pause());
  };
  loop();
}
