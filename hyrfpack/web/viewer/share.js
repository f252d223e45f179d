// Copies the address of the view, and saves a picture of it.

import { toast } from "./notifications.js";

// Copies the page's address with this camera and exposure (null for the default). `includesScene` is true if the
// address also opens the scene.
export async function shareView(camera, exposure, includesScene) {
  const address = new URL(location.href), { searchParams: parameters } = address;
  if (exposure) parameters.set("exposure", exposure);
  else if (parameters.has("exposure")) parameters.delete("exposure");
  address.hash = `camera=${camera}`;
  try {
    history.replaceState(null, "", address);
  } catch {
    // pages without an address of their own (srcdoc) cannot change it
  }
  const ending = includesScene ? "." : "; it does not include the opened file.";
  const copied = `The link to this view is copied${ending}`;
  try {
    await navigator.clipboard.writeText(address.href);
    toast(copied);
  } catch {
    toast("Copy this link:", address.href);
  }
}

// Downloads a picture (Blob), with the title in its file name.
export function savePicture(blob, title) {
  const link = document.createElement("a"), address = URL.createObjectURL(blob);
  Object.assign(link, { href: address, download: `${fileName(title)}.png` });
  link.click();
  setTimeout(() => URL.revokeObjectURL(address), 10_000);
  toast(`Saved as ${link.download}.`);
}

const fileName = (title) =>
  title.replace(/[^\p{L}\p{N}\x20._-]+/gu, "_").replace(/^[.\x20]+/, "").slice(0, 80) || "scene";
