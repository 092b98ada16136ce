// Runs before the first paint, so that the page does not flash in the other theme.
(() => {
  const root = document.documentElement;
  const asked = new URLSearchParams(location.search);
  let chosen = asked.get("theme");
  try { chosen = chosen || localStorage.getItem("labseq-theme"); } catch { /* no storage */ }
  if (chosen === "dark" || chosen === "light") root.dataset.theme = chosen;
  if (asked.get("wall") === "1") root.classList.add("wall");
})();
