// Every cycle of one body that the page can still show, column by column. Nothing is ever thinned out
// here; memory is allocated once.

export class History {
  constructor(names, capacity) {
    this.names = names;
    this.capacity = capacity;
    // Twice the room, so that a window of any length is one contiguous piece without copying.
    // Filled, so that all memory it will ever take is taken now.
    this.columns = Object.fromEntries(names.map((name) => [name, new Float64Array(2 * capacity).fill(NaN)]));
    this.cycle = this.columns.cycle;
    this.clear();
  }

  clear() {
    this.first = 0;
    this.end = 0;
  }

  append(table, row) {
    if (this.end === 2 * this.capacity) {
      const keep = this.capacity - 1;
      for (const name of this.names) this.columns[name].copyWithin(0, this.end - keep, this.end);
      this.end = keep;
      this.first = 0;
    }
    const offset = row * table.columns;
    for (let i = 0; i < this.names.length; i++) {
      this.columns[this.names[i]][this.end] = table.values[offset + i];
    }
    this.end++;
    this.first = Math.max(this.first, this.end - this.capacity);
  }

  get length() { return this.end - this.first; }

  last(name) { return this.length ? this.columns[name][this.end - 1] : NaN; }

  // First row whose cycle is at least `cycle`.
  find(cycle) {
    let low = this.first, high = this.end;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.cycle[middle] < cycle) low = middle + 1; else high = middle;
    }
    return low;
  }

  // Rows [start, stop) with cycles from `low` to `high`.
  range(low, high) { return [this.find(low), this.find(high + 1e-9)]; }
}
