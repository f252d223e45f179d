// A model that is still being trained: its server tells how far the training is, and has the newest snapshot of it.

const ASK_INTERVAL = 2000; // ms between two requests
const LOAD_RATIO = 3; // the next snapshot is asked for no sooner than so many times what the last one took to load
const MOST_FAILURES = 3; // in a row, after which the training has ended

const wait = (duration) => new Promise((done) => setTimeout(done, duration));

// {snapshot: number from 1, 0 while there is none, step, steps}, or null where the server does not answer.
async function askProgress(address) {
  try {
    const answer = await fetch(address, { cache: "no-store" });
    return answer.ok ? await answer.json() : null;
  } catch {
    return null;
  }
}

// Follow a training until its server answers no more or `wanted()` is false. `show(progress)`, a promise that a
// snapshot is shown, is called for the first one and for each newer one; `waiting()` while there is none.
export async function followTraining(address, { show, waiting, wanted }) {
  let shown = 0;
  for (let failures = 0; wanted() && failures < MOST_FAILURES; ) {
    const progress = document.hidden && shown ? { snapshot: shown } : await askProgress(address);
    failures = progress ? 0 : failures + 1;
    let took = 0;
    if (progress?.snapshot === 0) waiting();
    else if (progress && progress.snapshot !== shown && wanted()) {
      const began = performance.now();
      try {
        await show(progress);
        shown = progress.snapshot;
      } catch (error) {
        if (!shown) throw error; // else the next one may be better
      }
      took = performance.now() - began;
    }
    await wait(Math.max(ASK_INTERVAL, LOAD_RATIO * took));
  }
}

export const trainingTitle = (title, { step, steps }) => `${title}, step ${step.toLocaleString("en")} of ${steps.toLocaleString("en")}`;
