// Records, for each level of each chunk, whether its Gaussians are in memory, and which level of a chunk is drawn.

// States of a level: its file was not read, its Gaussians are being uploaded, they can be drawn, its file is unusable.
export const ABSENT = 0, UPLOADING = 1, READY = 2, UNUSABLE = 3;

class Level {
  // `level` is its number, `file` its entry in the manifest.
  constructor(level, file, rowCount) {
    Object.assign(this, { level, file, rowCount });
    this.usedAt = 0; // when it last suited a view
    this.isFinal = false; // whether it cannot be read again
    this.clear();
  }

  // Forgets its Gaussians.
  clear() {
    if (this.state !== UNUSABLE) this.state = this.isFinal ? UNUSABLE : ABSENT;
    this.rows = []; // of the textures
    this.positions = null; // of its Gaussians, 3 N
    this.packed = null; // the arrays of its Gaussians (see pack.js), before the first picture
  }
}

export class ChunkLevels {
  // `number` is that of the chunk, `chunk` its entry in the manifest, and `countRows` the number of rows of Gaussians.
  constructor(number, { levels }, countRows) {
    this.number = number;
    this.levels = levels.map((file, level) => new Level(level, file, countRows(file.gaussians)));
    this.coarsest = levels.length - 1;
    this.target = -1; // the level that suits the view, -1 for none
    this.isKept = true; // whether the coarsest level stays in memory whatever the view shows
    this.shown = -1; // the level that is drawn, or that is being faded in; -1 for none
    this.fading = null; // {from, to} while one level fades into another; -1 for none
  }

  // Forgets all Gaussians.
  clear() {
    this.shown = -1;
    this.fading = null;
    for (const level of this.levels) level.clear();
  }

  // Returns a level, or undefined for level -1.
  get(level) {
    return this.levels[level];
  }

  // The number of Gaussians in memory.
  get resident() {
    return this.levels.reduce((sum, { rows, file }) => sum + (rows.length ? file.gaussians : 0), 0);
  }

  // Returns whether a level can be drawn.
  isReady(level) {
    return this.get(level)?.state === READY;
  }

  // Returns the level that should be drawn: the target if it can be, else the present one, else any; -1 for none.
  // With `isShort` of memory, a level finer than the target is given up for the coarsest one, or for none.
  next(isShort) {
    const { target, shown, coarsest, isKept } = this;
    if (target < 0 || this.isReady(target)) return target;
    if (shown >= 0 && isShort && shown < target) {
      if (this.isReady(coarsest)) return coarsest;
      if (!isKept) return -1;
    }
    if (shown >= 0) return shown;
    return this.levels.findLast(({ state }) => state === READY)?.level ?? -1;
  }

  // Returns whether a level may be dropped: it is neither drawn nor wanted, nor the coarsest one if that is kept.
  isSpare({ level, state }) {
    const isFading = this.fading !== null && [this.fading.from, this.fading.to].includes(level);
    const isNeeded = [this.shown, this.target].includes(level) || (this.isKept && level === this.coarsest);
    return state === READY && !isFading && !isNeeded;
  }
}
