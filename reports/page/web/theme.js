// Light or dark: the setting of the system, until the reader selects one.
(function () {
  const root = document.documentElement;
  const button = document.getElementById("theme");
  const system = matchMedia("(prefers-color-scheme: dark)");
  const storage = (use) => { try { return use(localStorage); } catch { return null; } };
  const dark = () => root.dataset.theme ? root.dataset.theme === "dark" : system.matches;
  const name = () => { button.textContent = dark() ? "Light colors" : "Dark colors"; };
  const stored = storage((s) => s.getItem("report-theme"));
  if (stored === "light" || stored === "dark") root.dataset.theme = stored;
  button.hidden = false;
  button.addEventListener("click", () => {
    root.dataset.theme = dark() ? "light" : "dark";
    storage((s) => s.setItem("report-theme", root.dataset.theme));
    name();
  });
  system.addEventListener("change", name);
  // Paper is light.
  let before;
  addEventListener("beforeprint", () => {
    before = root.dataset.theme;
    root.dataset.theme = "light";
  });
  addEventListener("afterprint", () => {
    if (before) root.dataset.theme = before; else delete root.dataset.theme;
    name();
  });
  name();
})();
