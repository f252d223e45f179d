// Assigns rows of the textures to chunks.

export class RowPool {
  constructor(count) {
    this.isUsed = new Uint8Array(count);
    this.free = count; // the number of free rows
  }

  // Returns `count` free rows, the lowest ones, in rising order, which are then used; or null if there are too few.
  take(count) {
    if (count > this.free) return null;
    const rows = [];
    for (let row = 0; rows.length < count; row++) if (!this.isUsed[row]) rows.push(row);
    for (const row of rows) this.isUsed[row] = 1;
    this.free -= count;
    return rows;
  }

  // Frees rows.
  give(rows) {
    for (const row of rows) this.isUsed[row] = 0;
    this.free += rows.length;
  }
}

// Calls `visit(first, count, place)` for each run of consecutive rows in a rising list; `place` is the index of the
// run's first row in the list.
export function eachRun(rows, visit) {
  for (let place = 0, end; place < rows.length; place = end) {
    for (end = place + 1; rows[end] === rows[end - 1] + 1;) end++;
    visit(rows[place], end - place, place);
  }
}
