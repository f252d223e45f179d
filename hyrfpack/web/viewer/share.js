// Shares the address of the view, and saves a picture of it.

import { toast } from "./notifications.js";

const NOT_INCLUDED_TEXT = "A link would not include the opened file; send the file instead.";
const NOT_ON_WEB_TEXT = "This page is not on the web; send its file instead.";
const LOCAL_HOSTS = ["localhost", "127.0.0.1", "[::1]"];

// Puts this camera and exposure (null for the default) into the page's address. Then shares the address where touch
// screens can do so, or else copies it. `includesScene` is true if the address also opens the scene.
export async function shareView(camera, exposure, includesScene) {
  if (!includesScene) return toast(NOT_INCLUDED_TEXT);
  const address = new URL(location.href), { searchParams: parameters } = address;
  if (exposure) parameters.set("exposure", exposure);
  else if (parameters.has("exposure")) parameters.delete("exposure");
  if (parameters.has("poster")) parameters.delete("poster"); // it is of another view
  address.hash = `camera=${camera}`;
  try {
    history.replaceState(null, "", address);
  } catch {
    // pages without an address of their own (srcdoc) cannot change it
  }
  if (!/^https?:$/.test(address.protocol)) return toast(NOT_ON_WEB_TEXT);
  if (navigator.share && matchMedia("(pointer: coarse)").matches) {
    try {
      return await navigator.share({ title: document.title, url: address.href });
    } catch ({ name }) {
      if (name === "AbortError") return; // the user has closed the dialog
    }
  }
  const ending = LOCAL_HOSTS.includes(address.hostname) ? "; it works on this device only." : ".";
  try {
    await navigator.clipboard.writeText(address.href);
    toast(`The link to this view is copied${ending}`);
  } catch {
    toast("Copy this link:", address.href);
  }
}

// Downloads a Blob as a file whose name is made of a title and an ending. Returns the name.
export function saveBlob(blob, title, ending) {
  const link = document.createElement("a"), address = URL.createObjectURL(blob);
  Object.assign(link, { href: address, download: `${fileName(title)}${ending}` });
  link.click();
  setTimeout(() => URL.revokeObjectURL(address), 10_000);
  return link.download;
}

// Downloads a picture (Blob), with the title in its file name.
export function savePicture(blob, title) {
  toast(`Saved as ${saveBlob(blob, title, ".png")}.`);
}

const fileName = (title) =>
  title.replace(/[^\p{L}\p{N}\x20._-]+/gu, "_").replace(/^[.\x20]+/, "").slice(0, 80) || "scene";
