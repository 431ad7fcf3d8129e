"use strict";
(function () {
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  function draw(element) {
    const figure = JSON.parse(element.nextElementSibling.textContent);
    const layout = figure.layout;
    layout.paper_bgcolor = layout.plot_bgcolor = "rgba(0,0,0,0)";
    layout.font = { family: getComputedStyle(document.body).fontFamily, size: 12, color: css("--fg") };
    for (const axis of [layout.xaxis, layout.yaxis]) {
      axis.gridcolor = css("--grid");
      axis.linecolor = css("--soft");
    }
    if (dark.matches) {
      // Black and the dark blue would drown; everything else reads on both.
      const lift = { "#000000": "#ffffff", "#0072B2": "#4ba3dc" };
      const walk = (node) => {
        for (const key in node) {
          if (typeof node[key] === "string" && lift[node[key]]) node[key] = lift[node[key]];
          else if (node[key] && typeof node[key] === "object") walk(node[key]);
        }
      };
      walk(figure);
    }
    Plotly.react(element, figure.data, layout, { responsive: true, displaylogo: false, displayModeBar: false });
  }
  const charts = Array.from(document.querySelectorAll("[data-figure]"));
  const seen = new Set();
  // Charts are drawn when they come near the screen: a page may hold hundreds.
  const watch = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      if (entry.isIntersecting && !seen.has(entry.target)) {
        seen.add(entry.target);
        draw(entry.target);
      }
    }
  }, { rootMargin: "1500px" });
  charts.forEach((chart) => watch.observe(chart));
  window.addEventListener("beforeprint", () => charts.forEach((chart) => { seen.add(chart); draw(chart); }));
  dark.addEventListener("change", () => seen.forEach(draw));
})();
