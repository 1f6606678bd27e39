"use strict";
(() => {
  const PRINTED = [680, 800]; // pixels of a printed page, beside what stands around a chart
  const config = {
    displaylogo: false, displayModeBar: "hover", showTips: false, doubleClick: "reset",
    modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d", "toImage"],
  };
  const charts = JSON.parse(document.getElementById("page-charts").textContent);
  const plots = [...document.querySelectorAll(".drawing")];
  const widths = new Map();

  function draw(plot, width, mostHeight = Infinity) {
    const { data, layouts } = charts[plot.dataset.chart];
    widths.set(plot, width);
    const best = layouts.find((made) => made.width < 1.1 * width) ?? layouts.at(-1);
    // plotly.js writes into what it is given.
    const layout = structuredClone(best.layout);
    plot.style.height = `${layout.height}px`;
    plot.style.zoom = Math.min(1, mostHeight / layout.height);
    return Plotly.react(plot, data, { ...layout, width }, config);
  }

  function fit(plot) {
    const width = Math.floor(plot.parentElement.clientWidth);
    if (width > 0 && width !== widths.get(plot)) return draw(plot, width);
    return undefined;
  }

  const printing = window.matchMedia("print");
  const sizes = new ResizeObserver((entries) => {
    if (!printing.matches) entries.forEach(({ target }) => fit(target.querySelector(".drawing")));
  });

  // One after the other, so that the page can be read meanwhile.
  async function drawAll() {
    for (const plot of plots) {
      await fit(plot);
      sizes.observe(plot.parentElement);
      await new Promise((resolve) => { setTimeout(resolve); });
    }
    document.documentElement.dataset.drawn = plots.length;
  }
  window.addEventListener("beforeprint", () => plots.forEach((plot) => draw(plot, ...PRINTED)));
  window.addEventListener("afterprint", () => plots.forEach((plot) => fit(plot)));

  // Numbers as numbers, then words, and cells without anything last in both directions.
  function compared(a, b, sign) {
    if (a === "" || b === "") return (a === "") - (b === "");
    const [m, n] = [Number(a), Number(b)];
    if (Number.isNaN(m) !== Number.isNaN(n)) return Number.isNaN(m) - Number.isNaN(n);
    return sign * (Number.isNaN(m) ? a.localeCompare(b, "en", { numeric: true }) : m - n);
  }

  function sort(header) {
    const ascending = header.getAttribute("aria-sort") !== "ascending";
    for (const other of header.parentElement.children) other.setAttribute("aria-sort", "none");
    header.setAttribute("aria-sort", ascending ? "ascending" : "descending");
    const body = header.closest("table").tBodies[0];
    const value = (row) => row.cells[header.cellIndex].dataset.value;
    const sign = ascending ? 1 : -1;
    // The average over the rows stays below them.
    const below = (row) => row.cells[0].dataset.value === "average";
    const order = (a, b) => below(a) - below(b) || compared(value(a), value(b), sign);
    body.append(...[...body.rows].sort(order));
  }
  for (const header of document.querySelectorAll("th[aria-sort]")) {
    header.addEventListener("click", () => sort(header));
  }
  drawAll();
})();
