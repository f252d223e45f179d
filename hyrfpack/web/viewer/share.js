// What a person takes along: the address of what is seen, and a picture of it.

import { toast } from "./notes.js";

// The page's address with this camera and exposure (null for the usual one), copied. `holds`: whether it brings the
// scene, too.
export async function shareView(camera, exposure, holds) {
  const address = new URL(location.href), { searchParams: asked } = address;
  if (exposure) asked.set("exposure", exposure);
  else if (asked.has("exposure")) asked.delete("exposure");
  address.hash = `camera=${camera}`;
  try {
    history.replaceState(null, "", address);
  } catch {
    // a page without an address of its own, as in srcdoc
  }
  const copied = "The link to this view is copied" + (holds ? "." : "; it does not hold the file that you opened.");
  try {
    await navigator.clipboard.writeText(address.href);
    toast(copied);
  } catch {
    toast("Copy this link:", address.href);
  }
}

export function savePicture(blob, title) {
  const link = document.createElement("a"), address = URL.createObjectURL(blob);
  Object.assign(link, { href: address, download: `${fileName(title)}.png` });
  link.click();
  setTimeout(() => URL.revokeObjectURL(address), 10_000);
  toast(`Saved as ${link.download}.`);
}

const fileName = (title) => title.replace(/[^\p{L}\p{N}\x20._-]+/gu, "_").replace(/^[.\x20]+/, "").slice(0, 80) || "scene";
