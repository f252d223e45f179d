// Finds the address of the classic script hyrf-viewer.js, which is unknown where the script is part of a bundle.

const SCRIPT_NAME = "/hyrf-viewer.js";
const scriptAddress = globalThis.document?.currentScript?.src || null; // known only while the script runs first

// Returns the address of a file beside the script, or null if the script's address is unknown.
export function addressBesideScript(name) {
  const address = scriptAddress ?? findScript();
  return address && new URL(name, address).href;
}

// Returns the address of a script beside this one, or null if a page of this site may not use it as a worker.
export function siblingAddress(name) {
  const address = addressBesideScript(name);
  return address && new URL(address).origin === location.origin ? address : null;
}

// Finds the script among the page's scripts.
function findScript() {
  const addresses = [...document.querySelectorAll("script[src]")].map(({ src }) => src);
  return addresses.find((address) => new URL(address).pathname.endsWith(SCRIPT_NAME)) ?? null;
}
