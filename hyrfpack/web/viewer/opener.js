// Opens scenes in the player: the page's own, that of its address, and a file that the user chose.

import { resolveAddress } from "./address.js";
import { element } from "./dom.js";
import { dismiss, fail, progress } from "./notifications.js";
import { readPayload } from "./payload.js";
import { chosenFile, fetchedFile } from "./source.js";

// Reports a load or an error to the page around this one, where <hyrf-viewer> handles it.
export const postToParent = (hyrf, message = "") => {
  if (window.parent !== window) window.parent.postMessage({ hyrf, message }, "*");
};

// Returns the cameras of a file in the page's folder, {cameras, up, target}, or null if the page has none for it.
const findViews = (address, views = {}) => {
  const isAddressOf = (name) => new URL(encodeURI(name), document.baseURI).href === address;
  return Object.entries(views).find(([name]) => isAddressOf(name))?.[1] ?? null;
};

// Returns the file that the address or the page names: its address, null for none, "" for an invalid one; whether it is
// the page's own; and its views, null if the page has none. `served` and `parameters` are those of `openFirst`.
export function findFirstFile(served, parameters) {
  const own = served?.content ? resolveAddress(served.content, "content") : null;
  const address = parameters.content ?? own;
  return { address, isOwn: address === own, views: address ? findViews(address, served?.views) : null };
}

export class Opener {
  // `title` is that of the scene in the page. `watchTraining` is that of training.js, null in pages that follow none.
  constructor(player, panel, { title, watchTraining = null }) {
    Object.assign(this, { player, panel, watchTraining });
    // What is known of the scene that is shown: its title, and whether the page or its address names it, and not the
    // user. If it was opened, also the `name` of its file, and whether the page or its address names the title.
    this.shown = { title, isOwn: true };
    this.wanted = null; // the promise of the `open` that was called last, or of the one before if that one has failed
    this.invites = false; // whether nothing names a scene, so that the page asks for one
  }

  // Opens the scene that the page or its address names, if there is one. `hasFile` is true if the page has a file, and
  // `served` is the {content, title, views, updates} of a hosted page, or null. `parameters` are those of parseSearch.
  // `address` and `views` are those of findFirstFile.
  async openFirst(hasFile, served, parameters, { address, views }) {
    if (hasFile) {
      await this.player.load(readPayload(), element("background"));
      postToParent("load");
      return;
    }
    const isTraining = this.watchTraining && !parameters.content && served?.updates;
    const updates = isTraining ? resolveAddress(served.updates, "content") : null;
    if (updates) return this.watchTraining(this, address, updates, served.title);
    if (address) {
      const name = parameters.title ?? (parameters.content ? null : served.title);
      return this.open(async () => ({ ...(await fetchedFile(address)), views }), name);
    }
    element("loading").hidden = true;
    this.invites = parameters.content === null;
    this.invite();
  }

  // Asks for a file while there is none. A page that names its scene never does, because its visitors have no file.
  invite() {
    document.body.classList.toggle("empty", this.invites && !this.player.loaded);
  }

  // Opens a file that the user chose.
  openFile(file) {
    this.open(async () => chosenFile(file), null, false).catch(fail);
  }

  // Opens a scene. `fetchFile` returns a promise of {name, stream}. `name` is the scene's title; if it is null, the
  // file's name is.
  open(fetchFile, name = null, isOwn = true) {
    const before = this.wanted;
    dismiss();
    document.body.classList.remove("empty");
    progress(0);
    const open = async () => {
      try {
        const file = await fetchFile();
        // A scene that was opened meanwhile replaces this one only if it can be shown.
        let newest = null;
        while (own !== this.wanted && newest !== this.wanted) await (newest = this.wanted).catch(() => {});
        if (own !== this.wanted) return file.stream.cancel?.();
        const title = name ?? file.name.replace(/\.\w+$/, "");
        await this.player.open({ ...file, origin: { title, isNamed: name !== null, isOwn, name: file.name } });
        postToParent("load");
      } catch (error) {
        if (own !== this.wanted) return; // another scene was opened meanwhile
        this.wanted = before; // it may still be loading, and its errors matter again
        this.invite();
        throw error;
      }
    };
    const own = (this.wanted = open());
    return own;
  }
}
