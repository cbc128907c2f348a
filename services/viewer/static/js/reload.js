// Loads the page again if a part of it is missing. A browser drops what it is loading when a network interface comes or goes
// (ERR_NETWORK_CHANGED), and a page without one of its modules would stay empty.

const RELOAD_DELAY = 1000; // ms

// "error" of an element that loads something does not bubble, but can be captured on its way down.
addEventListener("error", ({ target }) => {
  if (!target.matches?.("script, link")) return;
  const banner = document.getElementById("banner");
  if (banner) {
    banner.textContent = "A part of this page could not be loaded. Loading it again…"; // without its button, whose code is missing
    banner.hidden = false;
  }
  setTimeout(() => location.reload(), RELOAD_DELAY);
}, true);
