// Shows the command that does what the edit does, and saves the edited file if only its metadata change.

import { element } from "../dom.js";
import { fail, toast } from "../notifications.js";
import { saveBlob } from "../share.js";
import { commandText } from "./actions.js";
import { canRewrite, rewriteFile } from "./rewrite.js";

const NOTHING_TEXT = "Nothing is edited yet.";
const COMMAND_TEXT = "Where Gaussians are removed, the command compresses the rest again, which takes it some minutes.";

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
    const { player, actions, opener } = this.editor, writer = document.querySelector("[name=generator]").content;
    const file = await rewriteFile(await player.loader.ask({}), actions, writer);
    toast(`Saved as ${saveBlob(new Blob([file]), opener.shown.title, "-edited.hyrf")}.`);
  }

  refresh() {
    const { actions, file } = this.editor, isWhole = canRewrite(actions);
    element("edit-command").value = actions.length ? commandText(actions, file) : NOTHING_TEXT;
    element("edit-copy").disabled = !actions.length;
    element("edit-download").disabled = !actions.length || !isWhole;
    element("edit-advice").textContent = isWhole ? "" : COMMAND_TEXT;
  }
}
