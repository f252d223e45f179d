// Keeps named views, plays a path through them, and saves both as cameras for `hyrfpack render --cameras`.

import { cameraOf } from "../camera.js";
import { element } from "../dom.js";
import { saveBlob } from "../share.js";
import { toast } from "../notifications.js";
import { dot } from "../../hyrf/vectors.js";
import { poseOnPath } from "./camera_path.js";

const PATH_FRAMES_PER_SECOND = 30;
const MAX_CAMERA_SIDE_PIXELS = 1920;

export class ViewsTool {
  constructor(editor) {
    this.editor = editor;
    this.reset();
    element("edit-new-view").onsubmit = (event) => {
      event.preventDefault();
      this.add(element("edit-view-name").value.trim() || this.nextName);
    };
    element("edit-seconds").oninput = () => this.refresh();
    element("edit-play").onclick = () => this.play();
    element("edit-save-views").onclick = () => this.saveViews();
    element("edit-save-path").onclick = () => this.savePath();
  }

  get nextName() {
    return `view ${this.added + 1}`;
  }

  get seconds() {
    return Number(element("edit-seconds").value) * (this.views.length - 1);
  }

  get poses() {
    return this.views.map(({ pose }) => pose);
  }

  enter() {
    element("edit-view-name").value = this.nextName;
    this.list();
  }

  leave() {
    if (this.isPlaying) this.editor.navigation.glide.stop();
  }

  reset() {
    this.views = []; // {name, pose: that of the eye}
    this.added = 0; // the number of views that were added, also of those that were removed
  }

  add(name) {
    this.views.push({ name, pose: this.editor.player.eye.pose });
    this.added++;
    this.enter();
  }

  // Lists the views, each with its name, a button that goes there, and one that removes it.
  list() {
    element("edit-views").replaceChildren(...this.views.map((view) => {
      const item = document.createElement("li"), name = document.createElement("input");
      const go = createButton("Go", () => this.go(view)), remove = createButton("✕", () => this.remove(view));
      const rename = () => {
        view.name = name.value = name.value.trim() || view.name;
        go.title = go.ariaLabel = `Go to ${view.name}`;
        remove.title = remove.ariaLabel = `Remove ${view.name}`;
      };
      Object.assign(name, { maxLength: 60, title: "Name", onchange: rename });
      rename();
      item.append(name, go, remove);
      return item;
    }));
    this.refresh();
  }

  go({ pose }) {
    const { navigation, player } = this.editor;
    navigation.stop();
    navigation.glide.to(() => Object.assign(player.eye, pose));
    player.changed();
  }

  remove(view) {
    this.leave(); // the path that is played had this view
    this.views = this.views.filter((other) => other !== view);
    this.list();
  }

  play() {
    if (this.isPlaying) return this.leave();
    const { poses } = this;
    this.isPlaying = true;
    this.editor.navigation.glide.follow((part) => poseOnPath(poses, part), this.seconds, () => {
      this.isPlaying = false;
      this.refresh();
    });
    this.refresh();
  }

  // Returns a camera of a pose for the scene after the actions of the edit.
  cameraOf(pose) {
    const { player, placement: { factor, rows } } = this.editor, { width, height } = player.canvas;
    const scale = Math.min(1, MAX_CAMERA_SIDE_PIXELS / Math.max(width, height));
    const sides = [width, height].map((side) => 2 * Math.max(1, Math.round((side * scale) / 2))); // even, for videos
    const eye = Object.assign(Object.create(player.eye), pose), camera = cameraOf(eye.view(...sides), player.scene);
    const moved = camera.camera_from_world.slice(0, 3).map((row) => {
      return [...rows.map((axis) => dot(axis, row)), factor * row[3]];
    });
    return { ...camera, camera_from_world: [...moved, [0, 0, 0, 1]] };
  }

  saveViews() {
    this.save(this.views.map(({ name, pose }) => ({ name, ...this.cameraOf(pose) })), "views");
  }

  savePath() {
    const frames = Math.round(this.seconds * PATH_FRAMES_PER_SECOND) + 1, { poses } = this;
    const digits = String(frames).length;
    this.save(Array.from({ length: frames }, (_, k) => {
      return { name: String(k).padStart(digits, "0"), ...this.cameraOf(poseOnPath(poses, k / (frames - 1))) };
    }), "path");
  }

  save(cameras, kind) {
    const text = JSON.stringify(cameras, null, 1), { title } = this.editor.opener.shown;
    const name = saveBlob(new Blob([text]), title, `-${kind}.json`);
    toast(`Saved as ${name}; 'hyrfpack render' reads it by --cameras.`);
  }

  refresh() {
    const { length } = this.views;
    element("edit-seconds").nextElementSibling.textContent = `${element("edit-seconds").value} s`;
    element("edit-play").textContent = this.isPlaying ? "Stop" : "Play";
    element("edit-save-views").disabled = length < 1;
    element("edit-play").disabled = element("edit-save-path").disabled = length < 2;
  }
}

const createButton = (text, onclick) =>
  Object.assign(document.createElement("button"), { textContent: text, onclick });
