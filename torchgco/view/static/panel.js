// The controls beside and below the picture. All text is set as text: nothing that the data says becomes HTML.
import { PARTS } from "./missions.js";
import { LAYERS, classColour } from "./searches.js";

export const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4];
const VIEWS = { "3-D": "perspective", Above: "above", Side: "side", Behind: "behind" };
const MANY = 400; // layouts above which they have no chips

export const by = (id) => document.getElementById(id);

/** An element with text, attributes and children. */
function make(tag, { text, children = [], ...attributes } = {}) {
  const made = document.createElement(tag);
  if (text !== undefined) made.textContent = text;
  for (const [name, value] of Object.entries(attributes)) {
    if (name in made) made[name] = value;
    else made.setAttribute(name, value);
  }
  made.append(...children);
  return made;
}

/** Fill what doesn't change with the layout, and call `act` for what the user asks for. */
export function build(head, act) {
  document.title = head.title;
  by("title").textContent = head.title;
  by("about").textContent = head.about;
  by("layout").replaceChildren(...head.layouts.map(({ label }, i) => make("option", { text: label, value: i })));
  by("layout").addEventListener("change", (event) => act.choose(Number(event.target.value)));
  by("previous").addEventListener("click", () => act.step(-1));
  by("next").addEventListener("click", () => act.step(1));
  const first = head.solvers[0]?.name;
  const chips = head.layouts.length > 1 && head.layouts.length <= MANY ? head.layouts : [];
  by("chips").replaceChildren(
    ...chips.map(({ label, results }, i) => {
      const result = results[first] ?? "failed";
      const named = `${label}: ${result}`;
      const chip = make("button", { title: named, "aria-label": named, "aria-pressed": "false", className: result });
      chip.addEventListener("click", () => act.choose(i));
      return chip;
    }),
  );
  by("views").replaceChildren(
    ...Object.entries(VIEWS).map(([name, view]) => {
      const button = make("button", { text: name, id: `view-${view}` });
      button.addEventListener("click", () => act.view(view));
      return button;
    }),
  );
  by("cut-label").hidden = head.dimension === 2;
  by("cut").addEventListener("input", (event) => act.cut(Number(event.target.value)));
  for (const name of ["follow", "through", "unknown", "grown", "searched", ...PARTS]) {
    by(name).addEventListener("change", (event) => act.toggle(name, event.target.checked));
  }
  by("grown").closest("label").hidden = Boolean(head.shape); // a body has no radius by which obstacles could grow
  by("play").addEventListener("click", act.play);
  by("time").addEventListener("input", (event) => act.time(Number(event.target.value)));
  by("speed").replaceChildren(...SPEEDS.map((speed) => make("option", { text: `${speed}×`, value: speed, selected: speed === 1 })));
  by("speed").addEventListener("change", (event) => act.speed(Number(event.target.value)));
  by("fold").addEventListener("click", () => {
    const folded = document.body.classList.toggle("folded");
    by("fold").setAttribute("aria-expanded", String(!folded));
    act.resize();
  });
  by("notes").replaceChildren(...head.notes.map((note) => make("li", { text: note })));
  if (head.layouts.length < 2) by("layout").closest("section").hidden = true;
}

/** Mark the chosen layout, and list its trajectories. */
export function showLayout(layout, number, head, visible, act) {
  by("layout").value = number;
  by("picture").dataset.layout = number;
  [...by("chips").children].forEach((chip, i) => chip.setAttribute("aria-pressed", String(i === number)));
  const flown = new Map(layout.flights.map((flight) => [head.solvers[flight.solver].name, flight]));
  by("solvers").replaceChildren(...head.solvers.map(({ name, seen }) => solver(name, seen, flown.get(name), visible, act)));
  const said = layout.flights.map((flight) => `${head.solvers[flight.solver].name}: ${flight.result}`);
  by("picture").setAttribute("aria-label", `${head.layouts[number].label}, in perspective. ${said.join("; ")}`);
}

function solver(name, colour, flight, visible, act) {
  const box = make("input", { type: "checkbox", checked: visible.has(name) && Boolean(flight), disabled: !flight });
  box.addEventListener("change", () => act.solver(name, box.checked));
  const swatch = make("span", { className: "swatch" });
  swatch.style.background = colour;
  const result = flight ? flight.result : "not flown";
  const children = [box, swatch, make("span", { text: name }), make("span", { text: result, className: `result ${result}` })];
  const rows = flight ? flight.rows.flatMap(([label, text]) => [make("dt", { text: label }), make("dd", { text })]) : [];
  return make("div", { className: "solver", children: [make("label", { children }), make("dl", { children: rows })] });
}

export function showTime(t, duration, playing) {
  by("time").max = duration;
  by("time").value = t;
  by("clock").textContent = `${t.toFixed(2)} of ${duration.toFixed(2)} s`;
  by("time").setAttribute("aria-valuetext", `${t.toFixed(2)} seconds`);
  by("play").textContent = playing ? "Pause" : "Play";
  by("play").setAttribute("aria-pressed", String(playing));
}

/** The switch of the cells that a map doesn't know, and what they count as; hidden where there are none. */
export function showUnknown(counts) {
  by("unknown-label").hidden = !counts;
  by("counts").textContent = counts ?? "";
}

/** The switches of a mission's parts, those that this layout has. */
export function showParts(names) {
  for (const name of PARTS) by(name).parentElement.hidden = !names.has(name);
  by("mission").hidden = names.size === 0;
}

/** The part of the panel that tells of the search; hidden where a layout has no record of one. */
export function showSearch(search, layers, act) {
  by("search").hidden = !search;
  if (!search) return;
  by("round").replaceChildren(...search.rounds.map(({ name }, i) => make("option", { text: name, value: i })));
  by("round").onchange = (event) => {
    listCandidates(search.rounds[Number(event.target.value)]);
    act.round(Number(event.target.value));
  };
  by("round").parentElement.hidden = search.rounds.length === 0;
  by("guide-label").hidden = search.guides.length === 0;
  by("guide").replaceChildren(...search.guides.map(({ name }, i) => make("option", { text: name, value: i })));
  by("guide").onchange = (event) => act.guide(Number(event.target.value));
  by("passes").replaceChildren(...search.passes.map((text) => make("li", { text })));
  const kinds = new Set(search.rounds.flatMap(({ lines }) => lines.map(({ kind }) => kind)));
  by("layers").replaceChildren(
    ...Object.entries(LAYERS).filter(([kind]) => kinds.has(kind)).map(([kind, text]) => {
      const box = make("input", { type: "checkbox", checked: layers.has(kind) });
      box.addEventListener("change", () => act.layer(kind, box.checked));
      return make("label", { children: [box, make("span", { text })] });
    }),
  );
  listCandidates(search.rounds[0]);
}

function listCandidates(round) {
  const told = (round?.lines ?? []).filter(({ text }) => text);
  by("candidates").replaceChildren(
    ...told.map(({ text, group }) => {
      const item = make("li", { text });
      item.style.borderLeft = `4px solid ${classColour(group)}`;
      item.style.paddingLeft = "6px";
      return item;
    }),
  );
}
