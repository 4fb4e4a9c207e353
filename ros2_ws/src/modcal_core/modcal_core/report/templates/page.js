"use strict";
document.documentElement.classList.add("js");
(() => {
  const root = document.documentElement, select = document.getElementById("theme");
  // a page from disk may not be allowed to remember
  const kept = (value) => { try { return value === undefined ? localStorage.getItem("theme") : localStorage.setItem("theme", value); } catch { return null; } };
  const show = (value) => {
    if (value === "system") delete root.dataset.theme; else root.dataset.theme = value;
    document.dispatchEvent(new Event("recolour"));
  };
  select.value = ["light", "dark"].includes(kept()) ? kept() : "system";
  show(select.value);
  select.addEventListener("change", () => { kept(select.value); show(select.value); });
  // paper is light
  for (const media of ["(prefers-color-scheme: dark)", "print"]) matchMedia(media).addEventListener("change", () => document.dispatchEvent(new Event("recolour")));

  for (const button of document.querySelectorAll("button[data-copy]")) {
    button.addEventListener("click", async () => {
      const code = button.parentElement.querySelector("code");
      try { await navigator.clipboard.writeText(code.textContent); button.textContent = "Copied"; }
      catch { getSelection().selectAllChildren(code); button.textContent = "Selected"; }
      setTimeout(() => { button.textContent = "Copy"; }, 2000);
    });
  }

  // a chart that is wider than the page is moved by keys too, as tables are
  const reach = () => document.querySelectorAll("figure .wide").forEach((e) => { if (e.scrollWidth > e.clientWidth) e.tabIndex = 0; else e.removeAttribute("tabindex"); });
  reach();
  addEventListener("resize", reach);
  document.addEventListener("toggle", reach, true);

  const closed = () => document.querySelectorAll("details:not([open]):not(.expert)");
  let opened = [];
  addEventListener("beforeprint", () => { opened = [...closed()]; opened.forEach((d) => { d.open = true; }); });
  addEventListener("afterprint", () => opened.forEach((d) => { d.open = false; }));
})();
