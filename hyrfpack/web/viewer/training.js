// Follows a training run through its server, which has the progress and the newest snapshot of the model.

import { remark } from "./notifications.js";
import { fetchedFile } from "./source.js";

const NOT_STARTED_TEXT = "The training has not taken its first step yet.";
const TRAINING_ENDED_TEXT = "The training no longer answers; this is its last snapshot.";
const NEVER_STARTED_TEXT = "The training ended before its first step; see its terminal.";

const REQUEST_INTERVAL_MS = 2000;
const WAIT_PER_LOAD_RATIO = 3; // the wait after a snapshot is at least this many times its loading time
const MAX_FAILURES = 3; // after this many consecutive failed requests, the run counts as ended

// Waits for a time in ms.
const wait = (duration) => new Promise((resolve) => setTimeout(resolve, duration));

// Requests the progress {snapshot, step, steps, kind}; `snapshot` counts from 1 and is 0 while there is none, `kind`
// names a run that is not the main one. Returns null if the server does not answer.
async function requestProgress(address) {
  try {
    const answer = await fetch(address, { cache: "no-store" });
    return answer.ok ? await answer.json() : null;
  } catch {
    return null;
  }
}

// Follows a training run until its server stops answering or `isFollowed()` is false. `show(progress)` is called for
// each new snapshot while `isWanted()`, and again if its promise does not resolve to true; `waiting()` is called while
// there is no snapshot.
async function followTraining(address, { show, waiting, isFollowed, isWanted }) {
  let shown = 0;
  for (let failures = 0; isFollowed() && failures < MAX_FAILURES; ) {
    const progress = document.hidden && shown ? { snapshot: shown } : await requestProgress(address);
    failures = progress ? 0 : failures + 1;
    let loadMs = 0;
    if (progress?.snapshot === 0) waiting();
    else if (progress && progress.snapshot !== shown && isWanted()) {
      const began = performance.now();
      try {
        if (await show(progress)) shown = progress.snapshot;
      } catch (error) {
        if (!shown) throw error; // after the first snapshot errors are ignored, because the next one may be valid
      }
      loadMs = performance.now() - began;
    }
    await wait(Math.max(REQUEST_INTERVAL_MS, WAIT_PER_LOAD_RATIO * loadMs));
  }
}

const trainingTitle = (title, { step, steps, kind }) =>
  `${title}, ${kind ? `${kind}, ` : ""}step ${step.toLocaleString("en")} of ${steps.toLocaleString("en")}`;

// Shows a model that is being trained, by the Opener of a page. Newer snapshots replace it without moving the eye.
export function watchTraining(opener, address, updates, sceneTitle) {
  const { player, panel } = opener;
  return new Promise((shown, failed) => {
    let own = opener.wanted, isShown = false;
    const isFollowed = () => opener.shown.isOwn; // until a file that the user opened is shown
    const isWanted = () => own === opener.wanted; // false while such a file is loading, which may still fail
    const show = async (training) => {
      const title = trainingTitle(sceneTitle, training);
      if (!isShown) {
        remark("");
        await (own = opener.open(() => fetchedFile(address), title));
        isShown = true;
        shown();
        return true;
      }
      const file = await fetchedFile(address), origin = { ...opener.shown, title };
      if (isWanted()) await player.open({ ...file, update: true, origin });
      else file.stream.cancel();
      if (!isWanted()) return false;
      opener.shown = origin;
      panel.setTitle(player.scene, title);
      return true;
    };
    const ended = followTraining(updates, { show, waiting: () => remark(NOT_STARTED_TEXT), isFollowed, isWanted });
    ended.then(() => {
      if (!isFollowed()) return;
      remark(isShown ? TRAINING_ENDED_TEXT : "");
      if (!isShown) failed(new Error(NEVER_STARTED_TEXT));
    }, failed);
  });
}
