// The API, from its OpenAPI document.
import { el, panel, replace, table } from "./dom.js";

export async function showApi(main) {
  const document_ = await (await fetch("/api/v1/openapi.json")).json();
  const parts = Object.entries(document_.paths).flatMap(([path, methods]) => Object.entries(methods).map(([method, one]) => operation(path, method, one)));
  replace(main, el("h1", {}, "API"), el("p", {}, document_.info.description), el("p.note", {}, el("a", { href: "/api/v1/openapi.json" }, "OpenAPI document"), " · ", el("a", { href: "/metrics" }, "Prometheus metrics")), el("div.api", {}, parts));
}

function operation(path, method, one) {
  const asked = one.parameters.map((p) => [p.name, p.in, p.schema.type, p.description]);
  const body = Object.entries(one.requestBody?.content["application/json"].schema.properties ?? {}).map(([name, about]) => [name, "body", "", about.description]);
  const kind = Object.keys(one.responses["200"].content)[0];
  const plain = method === "get" && !path.includes("{") && kind === "application/json";
  return panel(`${method.toUpperCase()} ${path}`, {}, el("p", {}, one.summary, el("span.note", {}, ` ${kind}`), plain ? [" ", el("a", { href: path }, "try it")] : null), [...asked, ...body].length ? table(["value", "in", "type", "meaning"], [...asked, ...body], { label: `Values of ${path}` }) : null);
}
