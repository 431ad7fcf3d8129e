// The charts: a point is named when pointed at, and linked to rows of the table.
(function () {
  const NEAR = 24; // pixels between the mouse and a point
  const SVG = "http://www.w3.org/2000/svg";
  const charts = Array.from(document.querySelectorAll("svg.chart"));
  const cache = new Map();
  const tip = document.createElement("div");
  tip.className = "tip";
  tip.hidden = true;
  document.body.append(tip);
  let current = null;

  const send = (name, keys) => document.dispatchEvent(new CustomEvent(name, { detail: keys }));

  // The points of a chart: place in its own pixels, text, color and keys of rows.
  function points(svg) {
    if (!cache.has(svg)) {
      const data = svg.nextElementSibling ? JSON.parse(svg.nextElementSibling.textContent) : { series: [] };
      const linear = (axis, v) => {
        const ends = [[axis.low, 0], ...(axis.bends ?? []), [axis.high, 1]];
        const place = (axis.bends ?? []).filter(([end]) => v > end).length;
        const [[low, before], [high, after]] = ends.slice(place, place + 2);
        return before + (after - before) * (v - low) / (high - low);
      };
      const share = (axis, v) => axis.log ? Math.log(v / axis.low) / Math.log(axis.high / axis.low)
        : linear(axis, v);
      const number = (axis, v) => axis.digits === null ? v.toLocaleString("en", { maximumSignificantDigits: 4 })
        : v.toFixed(axis.digits);
      const text = (axis, v) => axis.text ? axis.text.replace("{}", number(axis, v)) : "";
      cache.set(svg, data.series.flatMap((series) => series.x.map((x, i) => ({
        x: data.box[0] + data.box[2] * share(data.x, x),
        y: data.box[1] + data.box[3] * (1 - share(data.y, series.y[i])),
        text: [series.title, series.names?.[i] ?? "", text(data.x, x), text(data.y, series.y[i])],
        color: series.color,
        keys: series.keys?.[i] ?? [],
      }))));
    }
    return cache.get(svg);
  }

  function nearest(svg, event) {
    const box = svg.getBoundingClientRect(), scale = svg.viewBox.baseVal.width / box.width;
    const x = (event.clientX - box.x) * scale, y = (event.clientY - box.y) * scale;
    let best = null, least = NEAR * scale;
    for (const point of points(svg)) {
      const far = Math.hypot(point.x - x, point.y - y);
      if (far <= least) { best = point; least = far; }
    }
    return best;
  }

  function ring(svg, point, kind) {
    const circle = document.createElementNS(SVG, "circle");
    for (const [name, value] of Object.entries({ class: kind, cx: point.x, cy: point.y, r: 6, fill: point.color })) {
      circle.setAttribute(name, value);
    }
    svg.append(circle);
    return circle;
  }

  function show(svg, point, lines, event) {
    if (point !== current?.point) {
      current?.ring?.remove();
      const keys = point?.keys ?? [];
      if (keys.length || current?.point?.keys?.length) send("pointhover", keys);
      current = point && { point, ring: ring(svg, point, "ring") };
    }
    tip.hidden = !lines;
    if (!lines) return;
    tip.replaceChildren(...lines.filter(Boolean).map((text, i) => {
      const line = document.createElement(i ? "span" : "b");
      line.textContent = text;
      return line;
    }));
    const { innerWidth: width, innerHeight: height } = window;
    tip.style.left = `${Math.min(event.clientX + 14, width - tip.offsetWidth - 8)}px`;
    tip.style.top = `${Math.min(event.clientY + 14, height - tip.offsetHeight - 8)}px`;
  }

  document.addEventListener("pointermove", (event) => {
    const svg = event.target.closest("svg.chart");
    const about = event.target.dataset?.about;
    const point = svg && !about ? nearest(svg, event) : null;
    show(svg, point, about?.split("\n") ?? point?.text, event);
  });
  addEventListener("scroll", () => show(null, null, null, null), { passive: true });
  document.addEventListener("click", (event) => {
    const svg = event.target.closest("svg.chart");
    const keys = svg ? nearest(svg, event)?.keys ?? [] : [];
    if (keys.length) send("pointclick", keys);
  });
  // Points of marked rows stand out: all else in their charts is faint.
  document.addEventListener("rowsmarked", (event) => {
    const marked = event.detail;
    for (const svg of charts.filter((svg) => svg.nextElementSibling?.textContent.includes('"keys"'))) {
      svg.querySelectorAll(".marked").forEach((circle) => circle.remove());
      svg.classList.toggle("faint", marked.size > 0);
      for (const point of points(svg)) {
        const key = point.keys.find((name) => marked.has(name));
        if (key) ring(svg, point, "marked").dataset.key = key;
      }
    }
  });
})();
