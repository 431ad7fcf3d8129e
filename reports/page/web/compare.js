// Two pictures of a view on each other: slider, flip, or side by side; one on the page, one in a dialog.
(function () {
  const figures = Array.from(document.querySelectorAll("figure.panel")).filter((f) => f.querySelector(".compare"));
  const dialog = document.getElementById("compare");
  if (!figures.length) return;

  // Returns the function that shows a figure: its number, and the name of the right picture.
  function comparison(root) {
    const find = (selector) => root.querySelector(selector);
    const choice = { a: find("select[data-side=a]"), b: find("select[data-side=b]") };
    const image = { a: find("img[data-side=a]"), b: find("img[data-side=b]") };
    const mode = find("[data-mode]"), range = find("input[type=range]"), stage = find(".stage"), status = find("[role=status]");
    let pictures = new Map(), at = 0, second = false, truth = false;

    function show() {
      const names = { a: choice.a.value, b: choice.b.value };
      if (truth) names[mode.value === "flip" ? (second ? "b" : "a") : "b"] = "Ground truth";
      for (const side of ["a", "b"]) {
        const from = pictures.get(names[side]);
        if (!from) continue;
        if (image[side].src !== from.src) image[side].src = from.src;
        image[side].alt = from.alt;
        image[side].width = from.width;
        image[side].height = from.height;
      }
      const first = pictures.values().next().value;
      stage.style.setProperty("--aspect", first.getAttribute("width") / first.getAttribute("height"));
      stage.className = `stage ${mode.value}`;
      stage.style.setProperty("--at", `${range.value}%`);
      image.a.hidden = mode.value === "flip" && second;
      image.b.hidden = mode.value === "flip" && !second;
      find("[data-slider]").hidden = mode.value !== "slider";
      find("[data-do=flip]").hidden = mode.value !== "flip";
      find("[data-do=truth]").setAttribute("aria-pressed", truth);
      status.textContent = mode.value === "flip" ? `Shown: ${names[second ? "b" : "a"]}` : `${names.a} | ${names.b}`;
    }

    function fill(index, right) {
      at = (index + figures.length) % figures.length;
      const figure = figures[at];
      const before = { a: choice.a.value, b: right || choice.b.value };
      pictures = new Map(Array.from(figure.querySelectorAll("img[data-as]"), (img) => [img.dataset.as, img]));
      const names = Array.from(pictures.keys());
      for (const side of ["a", "b"]) {
        choice[side].replaceChildren(...names.map((name) => new Option(name, name)));
        if (names.includes(before[side])) choice[side].value = before[side];
        else choice[side].selectedIndex = side === "a" ? 0 : Math.min(1, names.length - 1);
      }
      find("h3").textContent = figure.dataset.view;
      second = truth = false;
      show();
    }

    const does = {
      close: () => root.close(),
      flip: () => { second = !second; },
      truth: () => { truth = !truth; },
      previous: () => fill(at - 1),
      next: () => fill(at + 1),
    };
    root.addEventListener("click", (event) => {
      const button = event.target.closest("[data-do]");
      if (button) { does[button.dataset.do](); show(); }
    });
    // An open dialog has all keys, the comparison on the page those of its own controls.
    document.addEventListener("keydown", (event) => {
      if (root === dialog ? !root.open : !root.contains(event.target)) return;
      if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("select")) return;
      const key = { f: "flip", g: "truth", p: "previous", n: "next" }[event.key.toLowerCase()];
      if (!key) return;
      event.preventDefault();
      if (key === "flip") mode.value = "flip";
      does[key]();
      show();
      if (event.target === range && key === "flip") find("[data-do=flip]").focus();
    });
    for (const input of [choice.a, choice.b, mode, range]) input.addEventListener("input", show);
    // The divider follows the mouse that drags it; the range does the same for the keyboard.
    stage.addEventListener("pointermove", (event) => {
      if (mode.value !== "slider" || !(event.buttons & 1)) return;
      const box = stage.getBoundingClientRect();
      range.value = 100 * (event.clientX - box.left) / box.width;
      show();
    });
    stage.addEventListener("dragstart", (event) => event.preventDefault());
    return fill;
  }

  const inline = document.querySelector("div.comparison");
  if (inline) {
    comparison(inline)(0);
    inline.hidden = false;
  }
  const fill = comparison(dialog);
  figures.forEach((figure, index) => {
    const open = (name) => { fill(index, name); dialog.showModal(); };
    const button = figure.querySelector(".compare");
    button.hidden = false;
    button.setAttribute("aria-label", `Compare pictures of ${figure.dataset.view}`);
    button.addEventListener("click", () => open());
    figure.addEventListener("click", (event) => {
      const img = event.target.closest(".pic")?.querySelector("img");
      if (img) open(img.dataset.as);
    });
  });
})();
