// Loads the page's modules from the page itself. Each becomes a module of its own under a blob's address, and the
// names after `from` in later ones are replaced by these addresses.
"use strict";

(async () => {
  const showError = (error) => {
    const place = document.getElementById("message");
    place.textContent = `This page can't be shown: ${error && error.message ? error.message : error}`;
    place.hidden = false;
    console.error(error);
  };
  window.addEventListener("error", (event) => showError(event.error || event.message));
  window.addEventListener("unhandledrejection", (event) => showError(event.reason));
  try {
    const inflated = async (text) => {
      const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
      const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
      return new Response(stream).text();
    };
    const addresses = {};
    const elements = [...document.querySelectorAll('script[data-kind="built"], script[data-kind="module"]')];
    const sources = await Promise.all(
      elements.map((element) => (element.dataset.kind === "built" ? inflated(element.textContent) : element.textContent)),
    );
    elements.forEach((element, i) => {
      const source = sources[i].replace(/from\s*"\.\/([\w.]+)"/g, (all, name) => {
        if (!(name in addresses)) throw new Error(`${element.id} comes before ${name}`);
        return `from"${addresses[name]}"`;
      });
      addresses[element.id] = URL.createObjectURL(new Blob([source], { type: "text/javascript" }));
    });
    const main = await import(addresses["main.js"]);
    await main.start();
    Object.values(addresses).forEach((address) => URL.revokeObjectURL(address));
  } catch (error) {
    showError(error);
  }
})();
