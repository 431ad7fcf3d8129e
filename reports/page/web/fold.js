// A link to a part that is folded unfolds it; so does printing.
(function () {
  const unfold = (element) => {
    for (let part = element && element.closest("details"); part; part = part.parentElement.closest("details")) part.open = true;
  };
  const follow = () => {
    const target = document.getElementById(decodeURIComponent(location.hash.slice(1)));
    if (!target) return;
    unfold(target);
    target.scrollIntoView();
  };
  addEventListener("hashchange", follow);
  addEventListener("beforeprint", () => document.querySelectorAll("details.part").forEach(unfold));
  if (location.hash) follow();
})();
