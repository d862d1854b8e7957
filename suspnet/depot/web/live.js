// Keeps the main part of a page up to date; without it the page stays as loaded.
"use strict";
const pulse = document.getElementById("pulse");
const lost = document.getElementById("lost");
let since = null;

const main = () => document.querySelector("main");
const filled = () => [...main().querySelectorAll("input:not([type=hidden]), select, textarea")].some(
  (one) => one === document.activeElement || (one.tagName !== "SELECT" && one.value !== one.defaultValue));

function twin(page, element) { // the same element in another version of the page
  if (element.id) return page.querySelector("#" + CSS.escape(element.id));
  const address = element.getAttribute("href");
  return address && page.querySelector(`a[href="${CSS.escape(address)}"]`);
}

async function replace() {
  const answer = await fetch(location.href, { cache: "no-store" });
  const page = new DOMParser().parseFromString(await answer.text(), "text/html");
  const old = main(), fresh = page.querySelector("main");
  if (!fresh || filled()) return;
  for (const one of fresh.querySelectorAll("noscript")) one.remove(); // read as if there were no scripts
  for (const one of old.querySelectorAll("details[id]")) {
    const same = twin(fresh, one);
    if (same) same.open = one.open;
  }
  fresh.prepend(...old.querySelectorAll(".said")); // the server sends a message once; it stays until the page is left
  const focused = old.contains(document.activeElement) ? document.activeElement : null;
  const places = [...old.querySelectorAll(".scroll")].map((one) => one.scrollLeft);
  const height = window.scrollY;
  old.replaceWith(document.adoptNode(fresh));
  document.title = page.title;
  fresh.querySelectorAll(".scroll").forEach((one, i) => { one.scrollLeft = places[i] || 0; });
  const same = focused && (focused === old ? fresh : twin(fresh, focused));
  if (same) same.focus({ preventScroll: true });
  window.scrollTo({ top: height, behavior: "instant" });
}

async function look() {
  try {
    const answer = await fetch(main().dataset.state, { cache: "no-store" });
    if (!answer.ok) throw new Error(answer.status);
    const state = await answer.json();
    since = null;
    lost.hidden = true;
    pulse.textContent = state.words;
    if (state.version !== main().dataset.version) {
      if (filled()) pulse.textContent = main().dataset.update;
      else await replace();
    }
  } catch (error) {
    since = since || new Date().toLocaleTimeString();
    lost.textContent = main().dataset.lost.replace("SINCE", since);
    lost.hidden = false;
  }
  if (main().dataset.state) setTimeout(look, 1000 * Number(main().dataset.every));
}
if (main().dataset.state) setTimeout(look, 1000 * Number(main().dataset.every));
