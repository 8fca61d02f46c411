"use strict";
// Fill the slots with what was recorded outside of the reproducible part of the pages.
const run = window.WORLDLINE_RUN || {};
for (const slot of document.querySelectorAll("[data-run]")) {
  const content = run[slot.dataset.run];
  if (content) slot.innerHTML = content;
}
// Theme: the system's choice until the reader makes one.
const root = document.documentElement;
document.getElementById("theme").addEventListener("click", () => {
  const dark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  root.dataset.theme = dark ? "light" : "dark";
});
// On narrow screens the navigation scrolls: begin at this page's own link.
const here = document.querySelector("nav .here");
if (here) here.parentElement.scrollLeft = here.offsetLeft - here.parentElement.offsetLeft - 40;
// Tabs: buttons that show one panel of their group.
for (const tabs of document.querySelectorAll(".tabs")) {
  const buttons = [...tabs.querySelectorAll("button")];
  const select = (chosen) => {
    for (const button of buttons) {
      const on = button === chosen;
      button.setAttribute("aria-selected", on);
      document.getElementById(button.dataset.panel).hidden = !on;
    }
    tabs.parentElement.dispatchEvent(new Event("change-view"));
  };
  buttons.forEach((button, index) => {
    button.addEventListener("click", () => select(button));
    button.addEventListener("keydown", (event) => {
      const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
      if (!step) return;
      const next = buttons[(index + step + buttons.length) % buttons.length];
      next.focus();
      select(next);
    });
  });
  select(buttons[0]);
}
// One player for each card: all of its videos show the same instant. Nothing is loaded before a card is seen; then it
// plays, unless the reader prefers less motion and starts it.
const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
const icons = { play: "M4 2l9 6-9 6z", pause: "M4 2h3v12H4zM9 2h3v12H9z" };
let rate = 1;
for (const card of document.querySelectorAll("[data-player]")) {
  const videos = [...card.querySelectorAll("video")];
  const bar = card.querySelector(".player");
  const [button, slider, clock] = bar ? [bar.querySelector("button"), bar.querySelector("input"), bar.querySelector("output")] : [];
  if (bar) bar.hidden = false;
  let wanted = !still, seen = false;
  const apply = () => {
    for (const video of videos) {
      video.playbackRate = rate;
      if (wanted && seen && video.offsetParent !== null) video.play().catch(() => {});
      else video.pause();
    }
    if (!bar) return;
    button.querySelector("path").setAttribute("d", wanted ? icons.pause : icons.play);
    button.setAttribute("aria-label", wanted ? "Pause" : "Play");
  };
  const show = () => {
    const [main, ...others] = videos.filter((video) => video.offsetParent !== null);
    if (!bar || !main || !main.duration) return;
    for (const video of others) {
      if (video.readyState > 0 && Math.abs(video.currentTime - main.currentTime) > 0.08) video.currentTime = main.currentTime;
    }
    slider.max = main.duration;
    slider.value = main.currentTime;
    clock.textContent = `${main.currentTime.toFixed(1)} / ${main.duration.toFixed(1)} s`;
  };
  const tick = () => { if (wanted && seen) show(); requestAnimationFrame(tick); };
  const toggle = () => { wanted = !wanted; apply(); };
  if (bar) {
    for (const video of videos) {
      video.removeAttribute("controls");
      video.addEventListener("click", toggle);
    }
    button.addEventListener("click", toggle);
    slider.addEventListener("input", () => {
      wanted = false;
      apply();
      for (const video of videos) video.currentTime = Number(slider.value);
      clock.textContent = `${Number(slider.value).toFixed(1)} / ${Number(slider.max).toFixed(1)} s`;
    });
    tick();
  }
  card.addEventListener("change-view", () => { show(); apply(); });
  card.addEventListener("change-rate", apply);
  new IntersectionObserver(([entry]) => { seen = entry.isIntersecting; apply(); }, { threshold: 0.2 }).observe(card);
  apply();
}
for (const button of document.querySelectorAll("[data-speed]")) {
  button.addEventListener("click", () => {
    const slow = button.getAttribute("aria-pressed") !== "true";
    button.setAttribute("aria-pressed", slow);
    rate = slow ? 0.4 : 1;
    document.querySelectorAll("[data-player]").forEach((card) => card.dispatchEvent(new Event("change-rate")));
  });
}
