// Shows the command that does what the edit does, and saves the edited file.

import { element } from "../dom.js";
import { fail, toast } from "../notifications.js";
import { saveBlob } from "../share.js";
import { commandText } from "./actions.js";
import { keepsGaussians, rewriteFile, writeKept } from "./rewrite.js";

const NOTHING_TEXT = "Nothing is edited yet.";
const UNCOMPRESSED_TEXT = "Save .hyrf stores it uncompressed, as the command with --profile raw.";

export class SaveTool {
  constructor(editor) {
    this.editor = editor;
    element("edit-copy").onclick = () => this.copy();
    element("edit-download").onclick = () => this.download().catch(fail);
  }

  async copy() {
    const text = element("edit-command");
    try {
      await navigator.clipboard.writeText(text.value);
      toast("The command is copied.");
    } catch {
      text.select();
      toast("The command is selected; copy it.");
    }
  }

  // Saves the edited file.
  async download() {
    const { player: { loader }, actions, opener } = this.editor, bytes = await loader.ask({});
    const writer = document.querySelector("[name=generator]").content;
    const file = keepsGaussians(actions)
      ? await rewriteFile(bytes, actions, writer)
      : writeKept(bytes, await loader.ask({ decode: true }), actions, writer);
    const name = saveBlob(new Blob([file]), opener.shown.title, "-edited.hyrf");
    toast(`Saved as ${name}, ${(file.length / 1e3).toFixed()} kB.`);
  }

  refresh() {
    const { actions, file, count, applied } = this.editor;
    element("edit-command").value = actions.length ? commandText(actions, file) : NOTHING_TEXT;
    element("edit-copy").disabled = !actions.length;
    element("edit-download").disabled = !actions.length || count === 0 || applied === null;
    element("edit-advice").textContent = keepsGaussians(actions) ? "" : UNCOMPRESSED_TEXT;
  }
}
