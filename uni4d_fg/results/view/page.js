// What the viewer's page does beyond viser: keys go to one place, and a phone shows the scene first.
(() => {
  if (window.uni4dPage) return;
  window.uni4dPage = true;
  const LONGEST_MS = 3000;
  // The panel waits for the first points: without a graphics card, drawing it takes half a second.
  const waits = document.createElement("style"), since = performance.now();
  waits.textContent = "body :not(canvas) { visibility: hidden !important }";
  document.head.append(waits);
  const show = () => {
    if (window.uni4dDetail?.seen || performance.now() - since > LONGEST_MS) waits.remove();
    else setTimeout(show, 20);
  };
  show();
  document.addEventListener("DOMContentLoaded", () => {
    // viser's hotkeys listen at the document: a slider or a button that has the focus has used the key already.
    document.body.addEventListener("keydown", (event) => {
      const target = event.target;
      const slides = target.getAttribute("role") === "slider" && event.key.startsWith("Arrow");
      if (slides || (target.tagName === "BUTTON" && event.code === "Space")) event.stopPropagation();
    });
    // The arrows that go by a frame would also turn the view for as long as they are held: viser's commands hear of a key
    // at the root, its camera at the document, which is asked last. A page to send has no commands.
    document.documentElement.addEventListener("keydown", (event) => {
      const steps = event.key === "ArrowLeft" || event.key === "ArrowRight";
      if (steps && !window.__VISER_EMBED_DATA__) event.stopPropagation();
    });
    // A check box that was clicked would keep the arrow keys to itself.
    document.body.addEventListener("click", (event) => {
      if (event.detail > 0 && event.target.type === "checkbox") event.target.blur();
    });
    // On narrow screens viser shows its panel over the lower half of the picture, with no option to begin closed. How
    // wide the screen is may not be known yet: where there is no such panel, nothing is found.
    const sheet = () => [...document.querySelectorAll('div[style*="max-height: 60%"]')].find(
      (div) => div.style.position === "fixed" && div.style.bottom === "0px");
    // The panel is made anew when settings arrive, and then begins open again; a finger opens and closes the same one.
    const closed = new WeakSet();
    new MutationObserver(() => {
      const handle = sheet()?.querySelector('div[style*="cursor: pointer"]');
      if (!handle || closed.has(handle)) return;
      closed.add(handle);
      handle.click();
    }).observe(document.body, { childList: true, subtree: true });
  });
})();
