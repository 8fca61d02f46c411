"use strict";
// Fill the slots with what was recorded outside the reproducible part of the page.
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
// One player for each card: all of its videos show the same instant. A card plays while it is seen; a reader who
// prefers less motion starts it.
const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
const icons = { play: "M4 2l9 6-9 6z", pause: "M4 2h3v12H4zM9 2h3v12H9z" };
let rate = 1;
for (const card of document.querySelectorAll("[data-player]")) {
  const videos = [...card.querySelectorAll("video")];
  if (!videos.length) continue;
  for (const video of videos) video.removeAttribute("controls");
  const bar = card.querySelector(".player");
  const [button, slider, clock] = [bar.querySelector("button"), bar.querySelector("input"), bar.querySelector("output")];
  bar.hidden = false;
  let wanted = !still, seen = false;
  const shown = () => videos.filter((video) => video.offsetParent !== null);
  const apply = () => {
    const playing = wanted && seen;
    const visible = shown();
    for (const video of videos) {
      video.playbackRate = rate;
      if (playing && visible.includes(video)) video.play().catch(() => {});
      else video.pause();
    }
    button.querySelector("path").setAttribute("d", wanted ? icons.pause : icons.play);
    button.setAttribute("aria-label", wanted ? "Pause" : "Play");
  };
  const show = () => {
    const main = shown()[0];
    if (!main || !main.duration) return;
    for (const video of videos) {
      if (video !== main && Math.abs(video.currentTime - main.currentTime) > 0.08) video.currentTime = main.currentTime;
    }
    slider.max = main.duration;
    slider.value = main.currentTime;
    clock.textContent = `${main.currentTime.toFixed(1)} / ${main.duration.toFixed(1)} s`;
  };
  const tick = () => { if (wanted && seen) show(); requestAnimationFrame(tick); };
  const toggle = () => { wanted = !wanted; apply(); };
  button.addEventListener("click", toggle);
  for (const video of videos) video.addEventListener("click", toggle);
  slider.addEventListener("input", () => {
    wanted = false;
    apply();
    for (const video of videos) video.currentTime = Number(slider.value);
    clock.textContent = `${Number(slider.value).toFixed(1)} / ${Number(slider.max).toFixed(1)} s`;
  });
  card.addEventListener("change-view", () => { show(); apply(); });
  videos[0].addEventListener("loadedmetadata", show);
  if ("IntersectionObserver" in window) {
    new IntersectionObserver(([entry]) => { seen = entry.isIntersecting; apply(); }, { threshold: 0.2 }).observe(card);
  } else { seen = true; }
  card.addEventListener("change-rate", apply);
  apply();
  tick();
}
for (const button of document.querySelectorAll("[data-speed]")) {
  button.addEventListener("click", () => {
    const slow = button.getAttribute("aria-pressed") !== "true";
    button.setAttribute("aria-pressed", slow);
    rate = slow ? 0.4 : 1;
    document.querySelectorAll("[data-player]").forEach((card) => card.dispatchEvent(new Event("change-rate")));
  });
}
// The section in view is marked in the navigation.
if ("IntersectionObserver" in window) {
  const links = new Map([...document.querySelectorAll("nav .links a")].map((a) => [a.getAttribute("href").slice(1), a]));
  const spy = new IntersectionObserver((entries) => {
    for (const { target, isIntersecting } of entries) links.get(target.id)?.classList.toggle("here", isIntersecting);
  }, { rootMargin: "-20% 0px -70% 0px" });
  document.querySelectorAll("main section").forEach((section) => spy.observe(section));
}
