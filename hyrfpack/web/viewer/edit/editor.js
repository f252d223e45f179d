// Edits the scene of a page: the panel with its tools, undo, and the command that does the same.

import { element } from "../dom.js";
import { announce, fail } from "../notifications.js";
import { frameAxes, rotateBack } from "../../hyrf/rotation.js";
import { placementAfter, selectionsOf } from "./actions.js";
import { CleanTool } from "./clean_tool.js";
import { CropTool } from "./crop_tool.js";
import { History } from "./history.js";
import { MeasureTool } from "./measure_tool.js";
import { Overlay } from "./overlay.js";
import { SaveTool } from "./save_tool.js";
import { UpTool } from "./up_tool.js";
import { ViewsTool } from "./views_tool.js";

const TOOLS_FOR_ANY_FILE = ["measure", "views"]; // these change nothing

export class Editor {
  // The arguments are those of startPage.
  constructor({ player, navigation, panel, opener, file }) {
    Object.assign(this, { player, navigation, panel, opener, ownFile: file });
    this.reset();
    this.overlay = new Overlay(player, () => this.drawn, (projection) => this.tool?.placed?.(projection));
    this.tools = {
      crop: new CropTool(this), clean: new CleanTool(this), up: new UpTool(this),
      measure: new MeasureTool(this), views: new ViewsTool(this), save: new SaveTool(this),
    };
    for (const button of document.querySelectorAll("[data-tool]")) {
      button.onclick = () => this.choose(button.dataset.tool);
    }
    const { actions } = panel, closeOthers = actions.Escape;
    actions.I = () => this.toggle();
    const isCovered = () => ["settings", "message", "toast"].some((id) => !element(id).hidden);
    actions.Escape = () => (element("edit").hidden || isCovered() ? closeOthers() : this.toggle(false));
    element("edit-undo").onclick = () => this.go(-1);
    element("edit-redo").onclick = () => this.go(1);
    addEventListener("keydown", (event) => this.key(event));
    player.addEventListener("opened", () => this.reset());
    player.addEventListener("loaded", () => this.offer());
    this.choose("crop");
  }

  // Forgets the edit of another scene.
  reset() {
    this.history = new History([]);
    this.actions = []; // those that are shown: the last state of the history, or one that is being changed
    this.count = null; // of the Gaussians that are left, null until it is known
    this.applied = "[]"; // the selections that the player shows, as JSON; null if that is unknown
    for (const tool of Object.values(this.tools ?? {})) tool.reset?.();
    if (this.tools) this.toggle(false);
  }

  // Offers to edit a scene that is loaded.
  offer() {
    const { whole, scene } = this.player;
    element("edit-button").hidden = !whole || scene.kind !== "hyrf" || scene.isStreamed;
  }

  // The name of the scene's file, or its path if the page knows it.
  get file() {
    const { isOwn, name } = this.opener.shown;
    return (isOwn && this.ownFile) || name;
  }

  get placement() {
    return placementAfter(this.actions, this.player.scene);
  }

  // The size of the scene in world units.
  get size() {
    return this.placement.factor * this.player.scene.unit;
  }

  // What the overlay draws.
  get drawn() {
    return (!element("edit").hidden && this.tool?.drawn) || {};
  }

  toggle(isOpen = element("edit").hidden) {
    if (isOpen && element("edit-button").hidden) return;
    element("edit").hidden = !isOpen;
    document.body.classList.toggle("editing", isOpen);
    element("edit-button").setAttribute("aria-expanded", isOpen);
    if (isOpen) this.panel.toggleSettings(false);
    this.choose(this.toolName);
  }

  choose(name) {
    this.tool?.leave?.();
    this.toolName = name;
    this.tool = this.tools[name];
    const isOpen = !element("edit").hidden, isMerged = Boolean(this.player.scene?.parts);
    const isRefused = isMerged && !TOOLS_FOR_ANY_FILE.includes(name);
    for (const button of document.querySelectorAll("[data-tool]")) {
      button.setAttribute("aria-pressed", button.dataset.tool === name);
    }
    for (const pane of document.querySelectorAll("[data-pane]")) pane.hidden = pane.dataset.pane !== name || isRefused;
    element("edit-refusal").hidden = !isRefused;
    element("edit-foot").hidden = element("edit-scale").hidden = isMerged;
    const isPicking = isOpen && Boolean(this.tool.pick);
    this.navigation.controls.pick = isPicking ? (x, y) => this.tool.pick(x, y) : null;
    document.body.classList.toggle("picking", isPicking);
    if (isOpen && !isRefused) this.tool.enter?.();
    this.refresh();
  }

  // Shows actions; if `isFinal`, they become a step that can be undone.
  set(actions, isFinal = true) {
    this.actions = actions;
    if (isFinal) this.history.add(actions);
    this.refresh();
    this.apply().catch(fail);
  }

  go(step) {
    this.history.go(step);
    this.set(this.history.state, false);
    announce(step < 0 ? "Undone" : "Redone");
  }

  key(event) {
    const key = event.key.toUpperCase(), isRedo = key === "Y" || event.shiftKey;
    if (element("edit").hidden || !(event.ctrlKey || event.metaKey) || !["Z", "Y"].includes(key)) return;
    if (event.target.closest?.("input:not([type='range'], [type='checkbox'])")) return; // it has its own undo
    event.preventDefault();
    element(isRedo ? "edit-redo" : "edit-undo").click(); // nothing happens if it is disabled
  }

  // Shows the state in the panel and over the scene.
  refresh() {
    const { scene } = this.player, { canUndo, canRedo } = this.history;
    element("edit-undo").disabled = !canUndo;
    element("edit-redo").disabled = !canRedo;
    if (!scene || element("edit").hidden) return this.overlay.draw();
    const all = scene.count.toLocaleString("en"), left = (this.count ?? scene.count).toLocaleString("en");
    element("edit-count").textContent = this.count === 0
      ? "No Gaussian is left." : `${left === all ? all : `${left} of ${all}`} Gaussians`;
    this.tool.refresh?.();
    this.overlay.draw();
  }

  // Applies the actions to the picture, the newest ones only if they change quickly.
  async apply() {
    const { player, placement: { rows, up } } = this;
    player.eye.up = rotateBack(frameAxes(player.scene), rotateBack(rows, up));
    if (this.isApplying) return;
    this.isApplying = true;
    try {
      for (;;) {
        const selections = selectionsOf(this.actions, player.scene), selectionsJson = JSON.stringify(selections);
        if (selectionsJson === this.applied) break;
        this.applied = null;
        this.count = (await player.select(selections)).at(-1) ?? null;
        this.applied = selectionsJson;
        this.refresh();
      }
    } finally {
      this.isApplying = false;
      this.refresh();
    }
  }
}
