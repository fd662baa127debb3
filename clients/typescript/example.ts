// Reads the newest value of an object; compiled by a test, so that the types stay usable.
import type { Calls, HistoryPage, MissionRequest, TaskView } from "./panelwright";

async function call<K extends keyof Calls>(name: K, path: string, body?: Calls[K]["body"]): Promise<Calls[K]["answer"]> {
  const answer = await fetch(`http://127.0.0.1:8460${path}`, { method: name.split(" ")[0], body: JSON.stringify(body) });
  if (!answer.ok) throw new Error(await answer.text());
  return (await answer.json()) as Calls[K]["answer"];
}

export async function newest(object: string): Promise<number | null> {
  const request: MissionRequest = { file: "inspect" };
  const task: TaskView = await call("POST /v1/missions", "/v1/missions?wait_s=30", request);
  const page: HistoryPage = await call("GET /v1/history/{object}", `/v1/history/${object}?limit=1`);
  return task.state === "succeeded" ? (page.readings?.[0]?.value ?? null) : null;
}
