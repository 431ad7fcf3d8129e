// The table of results: sorting, filters, details of rows, and the link to the charts' points.
(function () {
  const table = document.querySelector("table.results");
  if (!table) return;
  const $ = (selector) => document.querySelector(selector);
  const details = JSON.parse($("#details").textContent);
  const bodies = Array.from(table.tBodies);
  const heads = Array.from(table.tHead.rows[0].cells);
  // In any order, scenes precede the means of their dataset, and composed and edited scenes follow them.
  const ranks = { scene: 0, mean: 1, composed: 2, edited: 3 };
  const word = (one) => (typeof one === "number" ? details.words[one] : one);
  const methods = $("[data-filter=method]").options;
  const rows = Array.from(table.querySelectorAll("tr.row"), (tr, index) => {
    const kind = tr.classList[1], { dataset } = tr.parentNode.dataset;
    const data = {
      dataset, method: methods[+tr.dataset.m + 1].value, key: tr.dataset.key || word(details.rows[index][0]),
      status: tr.dataset.status || (kind === "mean" ? "mean" : "ok"),
    };
    const button = tr.cells[0].firstChild, text = `${dataset} ${tr.textContent}`.toLowerCase();
    button.setAttribute("aria-expanded", false);
    const name = document.createElement("span");
    name.className = "ds";
    name.textContent = `${dataset} / `;
    button.prepend(name);
    Object.assign(tr.dataset, { dataset, key: data.key });
    return { tr, index, body: tr.parentNode, data, detail: null, kind, button, text };
  });
  for (const hint of table.querySelectorAll("abbr[data-w]")) hint.title = details.reasons[hint.dataset.w];
  const byElement = new Map(rows.map((row) => [row.tr, row]));
  const flatBody = table.createTBody();
  let sorted = { column: -1, direction: 0 };

  function value(row, column) {
    const cell = row.tr.cells[column];
    if (heads[column].classList.contains("r")) {
      const number = parseFloat(cell.dataset.v || cell.textContent.replaceAll(",", ""));
      return Number.isNaN(number) ? null : number;
    }
    return cell.textContent.trim();
  }

  function place() {
    const flat = $("#flat").checked;
    const { column, direction } = sorted;
    const order = rows.slice();
    if (direction) {
      const values = new Map(rows.map((row) => [row, value(row, column)]));
      const words = new Intl.Collator("en", { numeric: true });
      order.sort((a, b) => {
        const x = values.get(a), y = values.get(b);
        if (ranks[a.kind] !== ranks[b.kind]) return ranks[a.kind] - ranks[b.kind];
        if (x === null || y === null) return (x === null) - (y === null) || a.index - b.index;
        const by = typeof x === "number" ? x - y : words.compare(x, y);
        return by * direction || a.index - b.index;
      });
    } else if (flat) {
      order.sort((a, b) => ranks[a.kind] - ranks[b.kind] || a.index - b.index);
    }
    const parts = new Map();
    for (const row of order) {
      const body = flat ? flatBody : row.body;
      if (!parts.has(body)) parts.set(body, document.createDocumentFragment());
      parts.get(body).append(row.tr);
      if (row.detail) parts.get(body).append(row.detail);
    }
    parts.forEach((part, body) => body.append(part));
    table.classList.toggle("flat", flat);
    show();
  }

  function sort(column) {
    // The first click brings the best to the top, the second turns it around, the third goes back.
    const best = +heads[column].dataset.better > 0 ? -1 : 1;
    const last = sorted.column === column ? sorted.direction : 0;
    const direction = last === 0 ? best : last === best ? -best : 0;
    sorted = { column, direction };
    heads.forEach((head, i) => {
      if (i === column && direction) head.setAttribute("aria-sort", direction > 0 ? "ascending" : "descending");
      else head.removeAttribute("aria-sort");
    });
    place();
  }

  const filters = Array.from(document.querySelectorAll("[data-filter]"));
  function show() {
    const filter = Object.fromEntries(filters.map((input) => [input.dataset.filter, input.value]));
    const words = filter.text.toLowerCase().split(/\s+/).filter(Boolean);
    let count = 0;
    const full = new Set();
    for (const row of rows) {
      const kind = row.kind === "mean" ? "mean" : "scene";
      const fits = ["dataset", "method", "status"].every((name) => !filter[name] || row.data[name] === filter[name])
        && (!filter.kind || filter.kind === kind) && words.every((word) => row.text.includes(word));
      row.tr.classList.toggle("off", !fits);
      if (row.detail) row.detail.classList.toggle("off", !fits || !row.open);
      if (fits) { count += 1; full.add(row.tr.parentNode); }
    }
    for (const body of bodies) body.rows[0].classList.toggle("off", !full.has(body));
    $("#count").textContent = count === rows.length ? `${count} rows` : `${count} of ${rows.length} rows`;
  }

  // To the page of a model: a file beside this page, which may be inside, too.
  function link(page) {
    const one = document.createElement("a"), held = details.inside[page];
    one.href = page;
    one.target = "_blank";
    one.textContent = "The model, to turn and edit";
    if (held) one.addEventListener("click", async (event) => {
      event.preventDefault();
      const packed = new Blob([Uint8Array.from(atob(held), (letter) => letter.charCodeAt(0))]);
      const text = await new Response(packed.stream().pipeThrough(new DecompressionStream("gzip"))).blob();
      open(URL.createObjectURL(new Blob([text], { type: "text/html" })));
    });
    return one;
  }

  function detail(row) {
    const line = document.createElement("tr");
    line.className = "detail";
    line.id = `detail-${row.index}`;
    const cell = line.insertCell();
    cell.colSpan = heads.length;
    const list = document.createElement("dl");
    details.rows[row.index].map(word).forEach((text, i) => {
      if (!text) return;
      const pair = document.createElement("div");
      const name = document.createElement("dt"), value = document.createElement("dd");
      if (text.length > 60) pair.className = "long";
      name.textContent = details.names[i];
      value.textContent = text;
      pair.append(name, value);
      list.append(pair);
    });
    cell.append(list);
    const model = details.models[word(details.rows[row.index][0])];
    if (model) cell.append(link(model));
    row.button.setAttribute("aria-controls", line.id);
    return line;
  }

  function toggle(row, open = !row.open) {
    row.open = open;
    if (open && !row.detail) { row.detail = detail(row); row.tr.after(row.detail); }
    if (row.detail) row.detail.classList.toggle("off", !open);
    row.button.setAttribute("aria-expanded", open);
    row.tr.classList.toggle("marked", open);
    mark();
  }

  // Open rows are marked in the charts.
  function mark() {
    const keys = new Set(rows.filter((row) => row.open).map((row) => row.data.key));
    document.dispatchEvent(new CustomEvent("rowsmarked", { detail: keys }));
  }

  heads.forEach((head, column) => head.firstChild.addEventListener("click", () => sort(column)));
  table.addEventListener("click", (event) => {
    const row = byElement.get(event.target.closest("tr"));
    // A selection of text opens no row.
    if (row && !event.target.closest("a") && getSelection().isCollapsed) toggle(row);
  });
  filters.forEach((input) => input.addEventListener("input", () => {
    // Words and statuses are of single scenes: what fits must not stay hidden.
    if (["text", "status"].includes(input.dataset.filter) && input.value) $("[data-filter=kind]").value = "";
    show();
  }));
  $("#flat").addEventListener("change", place);
  const initial = (input) => (input.options ? input.options[0].value : "");
  $("#reset").addEventListener("click", () => {
    filters.forEach((input) => { input.value = initial(input); });
    $("#flat").checked = false;
    rows.filter((row) => row.open).forEach((row) => toggle(row, false));
    sorted = { column: -1, direction: 0 };
    heads.forEach((head) => head.removeAttribute("aria-sort"));
    place();
  });
  document.addEventListener("pointhover", (event) => {
    for (const row of rows) row.tr.classList.toggle("hit", event.detail.includes(row.data.key));
  });
  document.addEventListener("pointclick", (event) => {
    const matches = rows.filter((row) => event.detail.includes(row.data.key));
    if (!matches.length) return;
    if (matches[0].tr.classList.contains("off")) {
      filters.forEach((input) => { input.value = ""; });
      show();
    }
    matches.forEach((row) => toggle(row, true));
    matches[0].tr.scrollIntoView({ block: "center" });
    matches[0].button.focus({ preventScroll: true });
  });
  $(".controls[role=search]").hidden = false;
  show();
})();
