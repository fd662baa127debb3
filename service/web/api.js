// Calls of the HTTP API. A problem (RFC 9457) becomes an Error whose message a person can read.

export class ProblemError extends Error {
  constructor(problem, status) {
    super(problem.detail || `the service answered ${status}`);
    this.hint = problem.hint || "";
    this.status = status;
    this.problem = problem;
  }
}

export async function get(path) {
  return answered(await fetch(path, { cache: "no-store" }));
}

export async function post(path, body) {
  const json = body === undefined ? {} : { headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) };
  return answered(await fetch(path, { method: "POST", ...json }));
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
