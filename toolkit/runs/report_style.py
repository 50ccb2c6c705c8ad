"""The style and the few lines of script of the report page; the dashboard wears the same."""

#: Colours on a light and on a dark ground, as custom properties that the rules below use.
LIGHT = """
  --ground: #f6f7f9; --card: #ffffff; --text: #1b2330; --muted: #657085; --line: #e2e6ec;
  --accent: #2563eb; --best: #0f7a4d; --best-ground: #e2f6ec; --warn: #8a5a00; --warn-ground: #fff4dc;
  --shade: 0 1px 2px rgba(20, 30, 50, .06), 0 6px 20px rgba(20, 30, 50, .05);
"""
DARK = """
  --ground: #0f1319; --card: #171d26; --text: #e4e9f1; --muted: #93a0b4; --line: #29313d;
  --accent: #7aa8ff; --best: #5fd6a0; --best-ground: #12362a; --warn: #f2c566; --warn-ground: #3a2d10;
  --shade: 0 1px 2px rgba(0, 0, 0, .4);
"""

#: Everything but colours. It holds inside shadow roots, too.
RULES = """
* { box-sizing: border-box; }
body {
  margin: 0; background: var(--ground); color: var(--text);
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Noto Sans", sans-serif;
  -webkit-text-size-adjust: 100%;
}
main { max-width: 1240px; margin: 0 auto; padding: 28px 20px 64px; }
header.page h1 {
  font-size: 28px; line-height: 1.2; letter-spacing: -.015em; margin: 0 0 4px; overflow-wrap: anywhere;
}
header.page p { margin: 0; color: var(--muted); }
h2 { font-size: 19px; letter-spacing: -.01em; margin: 40px 0 12px; }
p.note { color: var(--muted); margin: 0 0 12px; font-size: 14px; }
code, .mono, pre {
  font-family: ui-monospace, "SF Mono", Menlo, Consolas, "DejaVu Sans Mono", monospace; font-size: 12.5px;
}
.card, .scroll, details {
  background: var(--card); border: 1px solid var(--line); border-radius: 12px; box-shadow: var(--shade);
}
.dot {
  display: inline-block; width: 11px; height: 11px; border-radius: 50%; flex: none; background: var(--run);
}
.runs {
  display: grid; gap: 14px; grid-template-columns: repeat(auto-fit, minmax(min(270px, 100%), 1fr));
  margin-top: 22px;
}
.run { padding: 16px 18px; border-top: 3px solid var(--run); min-width: 0; }
.run h3 { display: flex; gap: 8px; align-items: center; font-size: 16px; margin: 0; overflow-wrap: anywhere; }
.run .badge { margin-left: auto; }
.run .what { color: var(--muted); font-size: 13.5px; overflow-wrap: anywhere; }
.badge {
  font-size: 12px; font-weight: 600; padding: 2px 9px; border-radius: 99px; background: var(--line);
  white-space: nowrap;
}
.badge.finished { background: var(--best-ground); color: var(--best); }
.badge.failed, .badge.interrupted, .badge.cancelled { background: var(--warn-ground); color: var(--warn); }
.numbers { display: flex; flex-wrap: wrap; gap: 6px 26px; margin: 14px 0 10px; }
.numbers div { display: flex; flex-direction: column-reverse; }
.numbers b {
  font-size: 22px; line-height: 1.25; font-weight: 650; font-variant-numeric: tabular-nums;
  white-space: nowrap;
}
.numbers span { font-size: 12px; color: var(--muted); }
.warnings {
  margin: 20px 0 0; padding: 12px 16px 12px 34px; border-radius: 12px; background: var(--warn-ground);
  color: var(--warn);
}
.warnings li + li { margin-top: 4px; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: 14px; }
th, td { padding: 8px 14px; text-align: left; vertical-align: top; border-bottom: 1px solid var(--line); }
tbody tr:last-child > * { border-bottom: 0; }
thead th { color: var(--muted); font-weight: 600; font-size: 13px; }
thead th .dot { margin-right: 7px; width: 9px; height: 9px; }
tbody th { font-weight: 500; position: sticky; left: 0; background: var(--card); }
tbody th small { color: var(--muted); font-weight: 400; margin-left: 6px; }
table.numeric td { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
table.single { width: auto; min-width: min(420px, 100%); }
table.numeric thead th:not(:first-child) { text-align: right; }
table.text td { overflow-wrap: anywhere; min-width: 11em; }
table.bars td {
  background: linear-gradient(var(--run, transparent), var(--run, transparent)) no-repeat left 14px bottom 3px;
  background-size: calc((100% - 28px) * (var(--part, 0))) 3px;
}
tr.group th { color: var(--muted); font-size: 12.5px; font-weight: 600; padding-bottom: 4px; }
td.differs { background: color-mix(in srgb, var(--accent) 13%, transparent); }
td.best b {
  display: inline-block; margin: -1px -8px; padding: 1px 8px; border-radius: 7px;
  background: var(--best-ground); color: var(--best);
}
td small { color: var(--muted); margin-left: 5px; }
table.total tbody tr:last-child > * { font-weight: 650; }
.charts { display: grid; gap: 14px; grid-template-columns: repeat(auto-fit, minmax(min(430px, 100%), 1fr)); }
@media (min-width: 930px) { .charts > :last-child:nth-child(odd):not(:only-child) { grid-column: 1 / -1; } }
.chart { padding: 10px 12px 4px; min-width: 0; overflow: hidden; }
.bar { display: flex; flex-wrap: wrap; align-items: center; gap: 8px 14px; margin: 0 0 12px; }
.choice {
  display: inline-flex; border: 1px solid var(--line); border-radius: 9px; overflow: hidden;
  background: var(--card);
}
.choice button {
  border: 0; background: none; color: var(--muted); font: inherit; font-size: 13.5px; padding: 6px 14px;
  cursor: pointer;
}
.choice button + button { border-left: 1px solid var(--line); }
.choice button[aria-pressed=true] { background: var(--accent); color: var(--card); font-weight: 600; }
:is(button, input, summary, .stack, .scroll):focus-visible {
  outline: 2px solid var(--accent); outline-offset: 2px;
}
.views {
  display: grid; gap: 16px; grid-template-columns: repeat(auto-fit, minmax(min(var(--view), 100%), 1fr));
}
.view { padding: 12px; min-width: 0; }
.view .top { display: flex; gap: 10px; align-items: center; margin: 0 2px 8px; }
.view h3 { margin: 0; font-size: 14px; font-weight: 600; overflow-wrap: anywhere; }
.zooms { margin-left: auto; display: flex; gap: 4px; }
.zooms button {
  min-width: 30px; height: 28px; border: 1px solid var(--line); border-radius: 7px; background: var(--card);
  color: var(--text); font: inherit; font-size: 13px; cursor: pointer;
}
.view .scale { margin: 8px 2px 0; font-size: 12.5px; }
.panels { display: grid; gap: 10px; grid-template-columns: repeat(auto-fit, minmax(min(220px, 100%), 1fr)); }
figure { margin: 0; min-width: 0; }
.stack {
  position: relative; border-radius: 8px; overflow: hidden; isolation: isolate; background: #000;
  cursor: ew-resize; touch-action: pan-y; user-select: none; line-height: 0;
}
.stack img {
  width: 100%; height: auto; display: block; -webkit-user-drag: none; transform-origin: 0 0;
  transform: translate(var(--shift-x, 0%), var(--shift-y, 0%)) scale(var(--zoom, 1));
}
.stack .over { position: absolute; inset: 0; clip-path: inset(0 0 0 var(--split)); }
.stack .over img { height: 100%; }
.stack .error { position: absolute; inset: 0; height: 100%; display: none; }
.zoomed .stack { touch-action: none; cursor: grab; }
.near img { image-rendering: pixelated; }
.stack::after {
  content: ""; position: absolute; top: 0; bottom: 0; left: var(--split); width: 2px; margin-left: -1px;
  background: #fff; box-shadow: 0 0 4px rgba(0, 0, 0, .6);
}
.tag {
  position: absolute; bottom: 8px; padding: 1px 7px; border-radius: 6px; background: rgba(0, 0, 0, .55);
  color: #fff;
  font-size: 11px; line-height: 1.6; pointer-events: none;
}
.tag.left { left: 8px; } .tag.right { right: 8px; }
[data-mode=photo] .over,
[data-mode=photo] .right,
[data-mode=render] .left,
[data-mode=difference] .tag,
[data-mode=error] .tag {
  display: none;
}
[data-mode=error] .error { display: block; }
.view .scale { display: none; }
[data-mode=error] .view .scale { display: block; }
[data-mode=render] .over, [data-mode=difference] .over { clip-path: none; }
[data-mode=difference] .over { mix-blend-mode: difference; }
[data-mode=difference] .stack { filter: brightness(2.5); }
[data-mode]:not([data-mode=slide]) .view:not(.zoomed) .stack { cursor: default; }
[data-mode]:not([data-mode=slide]) .stack::after { display: none; }
[data-mode]:not([data-mode=slide]) .view input { visibility: hidden; }
figcaption { display: flex; gap: 7px; align-items: center; font-size: 13px; margin: 6px 2px 0; min-width: 0; }
figcaption .name { overflow: hidden; text-overflow: ellipsis; white-space: nowrap; }
figcaption .score {
  margin-left: auto; color: var(--muted); white-space: nowrap; font-variant-numeric: tabular-nums;
}
figcaption .score b { color: var(--text); }
figcaption .score.best b { color: var(--best); }
.view input { width: 100%; margin: 8px 0 0; accent-color: var(--accent); }
details { margin: 10px 0; padding: 0 16px; }
summary { cursor: pointer; padding: 11px 0; font-weight: 550; overflow-wrap: anywhere; }
details .scroll { box-shadow: none; margin-bottom: 14px; }
pre {
  overflow: auto; max-height: 420px; margin: 0 0 14px; padding: 12px; border-radius: 8px;
  background: var(--ground);
}
footer { margin-top: 48px; color: var(--muted); font-size: 13px; }
@media (max-width: 560px) {
  main { padding: 18px 12px 48px; }
  header.page h1 { font-size: 23px; }
  th, td { padding: 7px 10px; }
  tbody th { max-width: 44vw; overflow-wrap: break-word; }
  tbody th small { display: block; margin: 0; }
}
@media print {
  .bar, .zooms, .view input { display: none; }
  .card, .scroll, details { box-shadow: none; break-inside: avoid; }
}
"""

CSS = f"""
:root {{ color-scheme: light dark; {LIGHT} }}
@media (prefers-color-scheme: dark) {{ :root {{ {DARK} }} }}
{RULES}"""

#: ``followViews(root)``: what cards of test pictures below ``root`` do; each dividing line follows the pointer, and
#: all pictures of a card are zoomed and moved together.
VIEW_SCRIPT = """
const MOST_ZOOM = 16;

function followViews(root) {
  for (const image of root.querySelectorAll("img[data-same]")) {
    image.src = root.querySelector("#" + image.dataset.same).src;
  }
  root.querySelectorAll(".view").forEach(followView);
}

function followView(view) {
  const range = view.querySelector("input");
  // How many times larger, and which place of the picture (0 to 1) is in the middle.
  let zoom = 1, x = 0.5, y = 0.5;

  const split = (percent) => {
    range.value = percent;
    view.style.setProperty("--split", percent + "%");
  };
  const limited = (value, low, high) => Math.min(high, Math.max(low, value));
  const look = (nextZoom, nextX, nextY) => {
    zoom = limited(nextZoom, 1, MOST_ZOOM);
    const edge = 0.5 / zoom;
    x = limited(nextX, edge, 1 - edge);
    y = limited(nextY, edge, 1 - edge);
    view.style.setProperty("--zoom", zoom);
    view.style.setProperty("--shift-x", 100 * (0.5 - zoom * x) + "%");
    view.style.setProperty("--shift-y", 100 * (0.5 - zoom * y) + "%");
    view.classList.toggle("zoomed", zoom > 1);
    view.classList.toggle("near", zoom >= 4);
  };
  // The place (px, py) stays where it is on the screen.
  const zoomAt = (factor, px, py) => {
    const next = limited(zoom * factor, 1, MOST_ZOOM);
    look(next, px - zoom * (px - x) / next, py - zoom * (py - y) / next);
  };
  const keys = {
    "+": () => zoomAt(2, x, y), "=": () => zoomAt(2, x, y),
    "-": () => zoomAt(0.5, x, y), "0": () => look(1, 0.5, 0.5),
    ArrowLeft: () => look(zoom, x - 0.1 / zoom, y), ArrowRight: () => look(zoom, x + 0.1 / zoom, y),
    ArrowUp: () => look(zoom, x, y - 0.1 / zoom), ArrowDown: () => look(zoom, x, y + 0.1 / zoom),
  };

  range.addEventListener("input", () => split(range.value));
  for (const button of view.querySelectorAll("[data-zoom]")) {
    const factor = Number(button.dataset.zoom);
    button.addEventListener("click", () => factor ? zoomAt(factor, x, y) : look(1, 0.5, 0.5));
  }
  for (const stack of view.querySelectorAll(".stack")) {
    const place = (event) => {
      const box = stack.getBoundingClientRect();
      const across = (event.clientX - box.left) / box.width, down = (event.clientY - box.top) / box.height;
      return { across, px: x + (across - 0.5) / zoom, py: y + (down - 0.5) / zoom, box };
    };
    const follow = (event) => {
      if (event.pointerType === "touch" && event.type === "pointermove" && !event.isPrimary) return;
      if (zoom > 1 && event.buttons) {
        if (event.type !== "pointermove") return stack.setPointerCapture(event.pointerId);
        const { box } = place(event);
        look(zoom, x - event.movementX / box.width / zoom, y - event.movementY / box.height / zoom);
      } else {
        split(limited(100 * place(event).across, 0, 100));
      }
    };
    stack.addEventListener("pointermove", follow);
    stack.addEventListener("pointerdown", follow);
    stack.addEventListener("dblclick", (event) => { const at = place(event); zoomAt(2, at.px, at.py); });
    stack.addEventListener("wheel", (event) => {
      if (!event.ctrlKey) return;  // the page scrolls; pinching a touchpad comes with this key
      event.preventDefault();
      const at = place(event);
      zoomAt(2 ** (-event.deltaY / 200), at.px, at.py);
    }, { passive: false });
    stack.addEventListener("keydown", (event) => {
      const arrow = event.key.startsWith("Arrow");
      if (!(event.key in keys) || event.ctrlKey || event.metaKey || (arrow && zoom === 1)) return;
      event.preventDefault();
      keys[event.key]();
    });
  }
}
"""

SCRIPT = (
    """
"use strict";
const figures = JSON.parse(document.getElementById("figures").textContent);
const dark = matchMedia("(prefers-color-scheme: dark)");
const config = {displaylogo: false, responsive: true, modeBarButtonsToRemove: ["lasso2d", "select2d"]};

function themed(figure) {
  const style = getComputedStyle(document.documentElement);
  const text = style.getPropertyValue("--text").trim(), card = style.getPropertyValue("--card").trim();
  const layout = structuredClone(figure.layout);
  layout.font = {...layout.font, color: text};
  layout.hoverlabel = {...layout.hoverlabel, bgcolor: card, font: {color: text}};
  return [figure.data, layout];
}

function draw(place) {
  const variants = figures[place.dataset.figure];
  const [data, layout] = themed(variants[place.dataset.variant] || variants.only);
  Plotly.react(place, data, layout, config);
}

const places = [...document.querySelectorAll("[data-figure]")];
places.forEach(draw);
dark.addEventListener("change", () => places.forEach(draw));

for (const choice of document.querySelectorAll(".choice")) {
  choice.addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (!button) return;
    for (const other of choice.children) other.setAttribute("aria-pressed", String(other === button));
    const section = choice.closest("section");
    section.dataset.mode = button.dataset.mode;
    for (const place of section.querySelectorAll("[data-variant]")) {
      place.dataset.variant = button.dataset.mode;
      draw(place);
    }
  });
}
"""
    + VIEW_SCRIPT
    + "followViews(document);\n"
)
