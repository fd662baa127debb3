// Shows the OpenAPI document of this service as a page, with nothing from other hosts.
import { get } from "./api.js";

const METHODS = ["get", "post", "put", "delete"];
const calls = document.querySelector("#calls");

function element(tag, text, children = []) {
  const made = document.createElement(tag);
  if (text) made.textContent = text;
  made.append(...children);
  return made;
}

// Returns a schema with its reference followed, and the name of what it refers to.
function followed(schema, root) {
  if (!schema?.$ref) return [schema ?? {}, ""];
  const name = schema.$ref.split("/").at(-1);
  return [root.components.schemas[name] ?? {}, name];
}

// Returns the type of a schema in a few words.
function typeOf(schema, root) {
  const [found, name] = followed(schema, root);
  if (name) return found.enum ? found.enum.map((one) => JSON.stringify(one)).join(" | ") : name;
  if (found.anyOf ?? found.oneOf) return (found.anyOf ?? found.oneOf).map((one) => typeOf(one, root)).join(" | ");
  if (found.enum) return found.enum.map((one) => JSON.stringify(one)).join(" | ");
  if ("const" in found) return JSON.stringify(found.const);
  if (found.type === "array") return found.items ? `list of ${typeOf(found.items, root)}` : "list";
  return found.type ?? "any";
}

function bounds(schema) {
  const least = schema.minimum ?? schema.exclusiveMinimum;
  const most = schema.maximum ?? schema.exclusiveMaximum;
  const told = [least === undefined ? "" : `from ${least}`, most === undefined ? "" : `to ${most}`, schema.pattern ? `like ${schema.pattern}` : ""];
  return told.filter(Boolean).join(" ");
}

function table(title, rows) {
  if (!rows.length) return [];
  const head = element("tr", "", ["name", "type", "meaning"].map((word) => element("th", word)));
  const body = rows.map((row) => element("tr", "", row.map((text) => element("td", text))));
  return [element("h3", title), element("table", "", [element("thead", "", [head]), element("tbody", "", body)])];
}

function fields(title, schema, root) {
  const [found, name] = followed(schema, root);
  const needed = new Set(found.required ?? []);
  const rows = Object.entries(found.properties ?? {}).map(([key, one]) => [
    needed.has(key) ? `${key} (needed)` : key,
    typeOf(one, root),
    [one.description, bounds(one), one.default === undefined || one.default === null ? "" : `by default ${JSON.stringify(one.default)}`].filter(Boolean).join("; "),
  ]);
  const made = rows.length ? table(`${title}${name ? `: ${name}` : ""}`, rows) : [element("h3", `${title}: ${typeOf(schema, root)}`)];
  if (found.description) made.splice(1, 0, element("p", found.description));
  return made;
}

function details(method, path, call, root) {
  const summary = element("summary", "", [element("b", method.toUpperCase()), element("code", path), element("span", call.summary ?? "")]);
  const made = element("details", "", [summary]);
  made.dataset.words = `${method} ${path} ${call.summary ?? ""} ${call.operationId ?? ""}`.toLowerCase();
  made.id = call.operationId ?? "";
  // Filled when it is opened, because the document is large.
  made.addEventListener("toggle", () => {
    if (!made.open || made.children.length > 1) return;
    if (call.description) made.append(element("p", call.description));
    const parameters = (call.parameters ?? []).map((one) => [
      `${one.name} (${one.in}${one.required ? ", needed" : ""})`, typeOf(one.schema, root), [one.description ?? one.schema?.description, bounds(one.schema ?? {})].filter(Boolean).join("; "),
    ]);
    made.append(...table("Parameters", parameters));
    const body = call.requestBody?.content?.["application/json"];
    if (body) made.append(...fields("Body", body.schema, root));
    if (body?.example) made.append(element("pre", JSON.stringify(body.example, null, 2)));
    for (const [status, answer] of Object.entries(call.responses ?? {})) {
      const [type, content] = Object.entries(answer.content ?? {})[0] ?? [];
      if (!status.startsWith("2")) continue;
      if (type === "application/json") made.append(...fields(`Answer ${status}`, content.schema, root));
      else made.append(element("h3", `Answer ${status}: ${type ?? "nothing"}`));
    }
    const refusals = Object.keys(call.responses ?? {}).filter((status) => !status.startsWith("2"));
    if (refusals.length) made.append(element("p", `Problems (RFC 9457): ${refusals.join(", ")}`));
  }, { once: false });
  return made;
}

function show(root) {
  document.querySelector("#version").textContent = `panelwright ${root.info.version}`;
  const groups = new Map();
  for (const [path, item] of Object.entries(root.paths)) {
    for (const method of METHODS.filter((one) => item[one])) {
      const group = item[method].tags?.[0] ?? "other";
      groups.set(group, [...(groups.get(group) ?? []), details(method, path, item[method], root)]);
    }
  }
  calls.replaceChildren(...[...groups].map(([name, made]) => element("section", "", [element("h2", name), ...made])));
  const nav = document.querySelector("#groups");
  for (const section of calls.children) {
    section.id = `group-${section.firstChild.textContent}`;
    const link = element("a", section.firstChild.textContent);
    link.href = `#${section.id}`;
    nav.append(link);
  }
}

document.querySelector("#search").addEventListener("input", (event) => {
  const words = event.target.value.toLowerCase().split(/\s+/).filter(Boolean);
  for (const section of calls.children) {
    const all = [...section.querySelectorAll("details")];
    for (const one of all) one.hidden = !words.every((word) => one.dataset.words.includes(word));
    section.hidden = all.every((one) => one.hidden);
  }
});

get("/openapi.json").then(show).catch((error) => {
  calls.replaceChildren(element("p", `${error.message}. ${error.hint ?? ""}`));
});
