// Draws the figures of a page by plotly, in the colours of the page, and zooms by buttons.
"use strict";
const CONFIG = { displaylogo: false, responsive: true, displayModeBar: innerWidth < 640 ? false : "hover",
  modeBarButtonsToRemove: ["lasso2d", "select2d"] };

const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

function dressed(layout) { // the texts, grids and labels of a figure in the colours of the page
  const found = { ...layout, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
    font: { ...layout.font, color: colour("--text") },
    modebar: { bgcolor: "rgba(0,0,0,0)", color: colour("--dim"), activecolor: colour("--link") },
    hoverlabel: { bgcolor: colour("--back"), font: { color: colour("--text") } } };
  for (const name of Object.keys(found).filter((one) => /^[xy]axis/.test(one))) {
    found[name] = { ...found[name], gridcolor: colour("--line"), linecolor: colour("--dim"), zeroline: false };
  }
  return found;
}

const km = (value) => Math.round(value).toLocaleString("en").replaceAll(",", "\u00a0");

const zoomed = (name) => document.querySelectorAll(`.js-plotly-plot[data-zoom="${name}"]`);

function say(plot) { // the range shown, in words and by its button; figures of the same name follow
  const { zoom } = plot.dataset;
  if (!zoom) return;
  const range = plot.layout.xaxis.range.map(Number);
  const out = document.querySelector(`output[data-zoom="${zoom}"]`);
  if (out) out.textContent = range.map(km).join(` ${out.dataset.to} `) + " km";
  for (const one of document.querySelectorAll(`button[data-zoom="${zoom}"]`)) {
    one.setAttribute("aria-pressed", Number(one.dataset.from) === range[0] && Number(one.dataset.to) === range[1]);
  }
  for (const one of zoomed(zoom)) {
    if (String(one.layout.xaxis.range.map(Number)) !== String(range)) Plotly.relayout(one, { "xaxis.range": [...range] });
  }
}

async function draw(plot) {
  const answer = await fetch(plot.dataset.figure, { cache: "no-store" });
  if (!answer.ok) return;
  const { data, layout } = await answer.json();
  const isNew = !plot.classList.contains("js-plotly-plot");
  const whole = layout.xaxis.range;
  const other = isNew && plot.dataset.zoom && zoomed(plot.dataset.zoom)[0];
  if (isNew) plot.textContent = "";
  if (other) layout.xaxis.range = other.layout.xaxis.range;
  else if (!isNew && whole && String(plot.layout.xaxis.range) !== plot.dataset.whole) layout.xaxis.range = plot.layout.xaxis.range;
  plot.dataset.whole = String(whole);
  const bar = plot.classList.contains("small") ? { displayModeBar: false } : {};
  await Plotly.react(plot, data, dressed(layout), { ...CONFIG, ...bar });
  if (isNew) plot.on("plotly_relayout", () => say(plot));
  say(plot);
}

function drawAll() { // a folded figure is drawn once it is unfolded, as its width is not known before
  for (const one of document.querySelectorAll(".plot[data-figure]")) if (!one.closest("details:not([open])")) draw(one);
  for (const one of document.querySelectorAll(".ranges")) one.hidden = false;
}

document.addEventListener("click", (event) => {
  const button = event.target.closest("button[data-zoom]");
  if (!button) return;
  const { from, to, zoom } = button.dataset;
  const [plot] = zoomed(zoom);
  if (plot) Plotly.relayout(plot, { "xaxis.range": [Number(from), Number(to)] });
});
document.addEventListener("toggle", (event) => {
  if (event.target.open && event.target.querySelector(".plot:not(.js-plotly-plot)")) drawAll();
}, true);
document.addEventListener("replaced", drawAll);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", drawAll);
drawAll();
