// The states of an edit, with undo and redo. States are values that never change.

export class History {
  constructor(state) {
    this.states = [state];
    this.place = 0;
  }

  get state() {
    return this.states[this.place];
  }

  get canUndo() {
    return this.place > 0;
  }

  get canRedo() {
    return this.place < this.states.length - 1;
  }

  // Adds a state, which replaces those that were undone.
  add(state) {
    if (JSON.stringify(state) === JSON.stringify(this.state)) return;
    this.states = [...this.states.slice(0, this.place + 1), state];
    this.place++;
  }

  // Goes back (-1) or forward (1).
  go(step) {
    this.place = Math.min(this.states.length - 1, Math.max(0, this.place + step));
  }
}
