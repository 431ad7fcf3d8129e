// The charts: drawn when they come near the screen, in the page's colors, with points linked to rows.
(function () {
  const charts = Array.from(document.querySelectorAll("[data-figure]"));
  const probe = document.createElement("span");
  probe.hidden = true;
  document.body.append(probe);
  const shade = (name) => { probe.style.color = `var(${name})`; return getComputedStyle(probe).color; };
  let marked = new Set();

  function library() {
    if (window.Plotly) return;
    const script = document.createElement("script");
    script.textContent = document.getElementById("plotly").textContent;
    document.head.append(script);
  }

  function draw(element) {
    library();
    const figure = JSON.parse(element.nextElementSibling.textContent);
    const layout = figure.layout;
    layout.paper_bgcolor = layout.plot_bgcolor = "rgba(0,0,0,0)";
    layout.font = { family: getComputedStyle(document.body).fontFamily, size: 12, color: shade("--fg") };
    layout.hoverlabel = { bgcolor: shade("--card"), bordercolor: shade("--soft"), font: { color: shade("--fg") } };
    for (const name of Object.keys(layout).filter((key) => /^[xy]axis/.test(key))) {
      layout[name].gridcolor = shade("--grid");
      layout[name].linecolor = shade("--soft");
    }
    if (document.documentElement.dataset.shown === "dark") {
      // Black, the dark blue and the vermilion would drown; everything else reads on both.
      const lift = { "#000000": "#ffffff", "#0072B2": "#4ba3dc", "#D55E00": "#f2803a" };
      const walk = (node) => {
        for (const key in node) {
          if (typeof node[key] === "string" && lift[node[key]]) node[key] = lift[node[key]];
          else if (node[key] && typeof node[key] === "object") walk(node[key]);
        }
      };
      walk(figure);
    }
    figure.data.forEach((trace) => { trace.selectedpoints = selected(trace); });
    const known = element.data !== undefined;
    Plotly.react(element, figure.data, layout, { responsive: true, displaylogo: false, displayModeBar: false });
    if (known) return;
    const tell = (name, keys) => document.dispatchEvent(new CustomEvent(name, { detail: keys }));
    const keys = (event) => event.points[0].data.meta?.keys?.[event.points[0].pointNumber] ?? [];
    element.on("plotly_hover", (event) => tell("pointhover", keys(event)));
    element.on("plotly_unhover", () => tell("pointhover", []));
    element.on("plotly_click", (event) => { if (keys(event).length) tell("pointclick", keys(event)); });
  }

  // Points that stand for a marked row; null while nothing is marked, which shows all alike.
  function selected(trace) {
    if (!marked.size || !trace.meta?.keys) return null;
    return trace.meta.keys.flatMap((keys, i) => (keys.some((key) => marked.has(key)) ? [i] : []));
  }

  const seen = new Set();
  const watch = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      if (entry.isIntersecting && !seen.has(entry.target)) {
        seen.add(entry.target);
        draw(entry.target);
      }
    }
  }, { rootMargin: "1000px" });
  charts.forEach((chart) => watch.observe(chart));
  document.addEventListener("rowsmarked", (event) => {
    marked = event.detail;
    for (const chart of seen) {
      if (chart.data.some((trace) => trace.meta?.keys)) {
        Plotly.restyle(chart, { selectedpoints: chart.data.map(selected) });
      }
    }
  });
  document.addEventListener("themechange", () => seen.forEach(draw));
  addEventListener("beforeprint", () => charts.forEach((chart) => { seen.add(chart); draw(chart); }));
})();
