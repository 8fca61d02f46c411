"use strict";
// The box above filters the cards by words; a video loads its first frame when it is first seen.
const box = document.getElementById("filter"), shown = document.getElementById("shown");
const cards = [...document.querySelectorAll("[data-text]")];
function filter() {
  const words = box.value.toLowerCase().split(/\s+/).filter(Boolean);
  let count = 0;
  for (const card of cards) {
    card.hidden = !words.every((word) => card.dataset.text.includes(word));
    count += !card.hidden;
    if (card.hidden) card.querySelector("video")?.pause();
  }
  shown.textContent = `${count} of ${cards.length}`;
}
box.addEventListener("input", filter);
filter();
const seen = new IntersectionObserver((entries) => {
  for (const { target, isIntersecting } of entries) {
    if (!isIntersecting) continue;
    target.preload = "metadata";
    seen.unobserve(target);
  }
});
document.querySelectorAll("video").forEach((video) => seen.observe(video));
