// Streams of tokens (docs/format.md 3.1): interleaved rANS.

import { needSound } from "./errors.js";

const MOST_TOKENS = 126; // of an alphabet
const MOST_MODELS = 1024;
const MOST_LANES_LOG2 = 13;
const MOST_STEPS = 65536; // of a lane, where there could be more lanes
const MOST_COUNT = 2 ** 31; // of tokens: what is computed here stays exact, and no array is longer anyway
const SCALE_BITS = 12;
const SCALE = 1 << SCALE_BITS; // what the frequencies of a model add up to
const LANE_END = 65536; // state of a lane after its last token
const HIGHEST_LEVEL = 49; // of a static model
const ROW = 128; // places of a model in the tables: one more than tokens, and a power of two
const BUCKET_BITS = 4; // of a position in a model that do not choose its bucket
const BUCKETS = SCALE >> BUCKET_BITS;

/** The weight of each level of a static model. */
const LEVEL_WEIGHTS = [0];
for (let level = 0; level < HIGHEST_LEVEL; level++) LEVEL_WEIGHTS.push((4 + (level % 4)) * 2 ** (level >> 2));

/**
 * @param {Uint8Array | null} contexts
 * @returns {number} the largest, plus 1
 */
const contextCount = (contexts) => {
  let largest = 0;
  if (contexts) for (let i = 0; i < contexts.length; i++) if (contexts[i] > largest) largest = contexts[i];
  return largest + 1;
};

/**
 * Tokens out of the bytes they begin.
 * @param {Uint8Array} data
 * @param {number} count
 * @param {Uint8Array | null} contexts of each token; null if there is one context
 * @param {boolean} [mayBeStatic]
 * @returns {{tokens: Uint8Array, end: number}} `end`: bytes that they took
 * @throws {DamagedData}
 */
export const decodeTokens = (data, count, contexts, mayBeStatic = true) => {
  if (count === 0) return { tokens: new Uint8Array(0), end: 0 };
  needSound(data.length >= 2 && count < MOST_COUNT, "a stream ends within its header");
  const alphabet = data[1], kinds = contextCount(contexts);
  if (alphabet === 0) return constantTokens(data, count, contexts, kinds);
  const lanesLog2 = data[0] & 15, classes = ((data[0] >> 4) & 7) + 1, isStatic = data[0] >= 128;
  const models = kinds * classes;
  const isKnown = alphabet <= MOST_TOKENS && models <= MOST_MODELS && lanesLog2 <= MOST_LANES_LOG2;
  needSound(isKnown && (mayBeStatic || !isStatic), "a stream's header says what cannot be");
  needSound(count <= MOST_STEPS * 2 ** lanesLog2 || lanesLog2 === MOST_LANES_LOG2, "a stream has too few lanes");
  let place = 2 + classes - 1;
  const classAfter = classesAfter(data.subarray(2, place), alphabet);
  const tables = new ModelTables(models, alphabet);
  if (isStatic) place += readStaticModels(data.subarray(Math.min(place, data.length)), tables);
  return decodeLanes(data, place, count, contexts, classes, classAfter, tables, 2 ** lanesLog2, isStatic);
};

/**
 * Tokens that follow from their contexts.
 * @param {Uint8Array} data
 * @param {number} count
 * @param {Uint8Array | null} contexts
 * @param {number} kinds of contexts
 */
const constantTokens = (data, count, contexts, kinds) => {
  const end = 2 + kinds, only = data.subarray(2, end);
  const isKnown = data[0] === 0 && only.length === kinds && only.every((token) => token < MOST_TOKENS);
  needSound(isKnown, "the tokens of a stream's contexts are missing or damaged");
  const tokens = new Uint8Array(count);
  if (contexts && kinds > 1) for (let i = 0; i < count; i++) tokens[i] = only[contexts[i]];
  else tokens.fill(only[0]);
  return { tokens, end };
};

/**
 * The class that follows each token.
 * @param {Uint8Array} thresholds
 * @param {number} alphabet
 */
const classesAfter = (thresholds, alphabet) => {
  const edges = [0, ...thresholds, alphabet];
  const doRise = edges.every((edge, i) => i === 0 || edges[i - 1] < edge);
  needSound(doRise, "the thresholds of a stream's classes do not rise");
  return Uint8Array.from({ length: alphabet }, (_, token) => thresholds.filter((edge) => edge <= token).length);
};

/** What frequencies of tokens mean for a decoder, model by model. */
class ModelTables {
  /**
   * @param {number} models
   * @param {number} alphabet
   */
  constructor(models, alphabet) {
    this.models = models;
    this.alphabet = alphabet;
    /** Where each token begins: f_0 + ... + f_(j-1); ROW for a model. */
    this.sums = new Uint16Array(models * ROW);
    /** The token at the first position of each bucket; BUCKETS for a model. */
    this.firsts = new Uint8Array(models * BUCKETS);
    /** Weights of static models, ROW for a model. */
    this.weights = new Float64Array(ROW);
  }

  /**
   * Take the weights in `weights` for a model. Numbers stay below 2^53 as weights stay below 2^47.
   * @param {number} model
   */
  build(model) {
    const { weights, alphabet, sums, firsts } = this;
    let sum = 0, largest = 0;
    for (let token = 0; token < alphabet; token++) {
      sum += weights[token];
      if (weights[token] > weights[largest]) largest = token;
    }
    const row = model * ROW;
    let rest = SCALE;
    for (let token = 0; token < alphabet; token++) {
      // floor(4096 w / sum), in two halves of 6 bits.
      const scaled = weights[token] * 64, high = Math.floor(scaled / sum);
      const frequency = 64 * high + Math.floor(((scaled - high * sum) * 64) / sum);
      sums[row + token] = frequency || +(weights[token] > 0);
      rest -= sums[row + token];
    }
    sums[row + largest] += rest;
    const buckets = model * BUCKETS;
    let start = 0, bucket = 0;
    for (let token = 0; token < alphabet; token++) {
      const end = start + sums[row + token];
      sums[row + token] = start;
      for (; bucket << BUCKET_BITS < end; bucket++) firsts[buckets + bucket] = token;
      start = end;
    }
    sums[row + alphabet] = SCALE;
  }
}

/**
 * Build static models from their levels.
 * @param {Uint8Array} data
 * @param {ModelTables} tables
 * @returns {number} bytes that the levels took
 */
const readStaticModels = (data, tables) => {
  const { models, alphabet, weights } = tables;
  const { tokens, end } = decodeTokens(data, models * alphabet, null, false);
  const levels = new Int32Array(alphabet);
  for (let model = 0, at = 0; model < models; model++) {
    let some = 0;
    for (let token = 0; token < alphabet; token++, at++) {
      const difference = (tokens[at] >> 1) ^ -(tokens[at] & 1);
      levels[token] = difference + (model ? levels[token] : token ? levels[token - 1] : 0);
      needSound(levels[token] >= 0 && levels[token] <= HIGHEST_LEVEL, "a model has a level out of range");
      weights[token] = LEVEL_WEIGHTS[levels[token]];
      some += weights[token];
    }
    needSound(some > 0, "a model has no frequencies");
    tables.build(model);
  }
  return end;
};

/**
 * @param {Uint8Array} data
 * @param {number} place of the states
 * @param {number} count
 * @param {Uint8Array | null} contexts
 * @param {number} classes
 * @param {Uint8Array} classAfter
 * @param {ModelTables} tables
 * @param {number} asked lanes
 * @param {boolean} isStatic
 */
const decodeLanes = (data, place, count, contexts, classes, classAfter, tables, asked, isStatic) => {
  const { models, alphabet, sums, firsts, weights } = tables;
  const least = Math.ceil(count / asked), steps = least % 2 ? least : least + 1;
  const used = Math.ceil(count / steps), last = count - (used - 1) * steps;
  let word = place + 4 * used;
  needSound(word <= data.length, "a stream ends within the states of its lanes");
  const wordsEnd = word + Math.floor((data.length - word) / 2) * 2;
  const view = new DataView(data.buffer, data.byteOffset, data.length);
  const states = Int32Array.from({ length: used }, (_, lane) => view.getInt32(place + 4 * lane, true));
  const tokens = new Uint8Array(count);
  const classOf = new Uint8Array(used);

  // Adaptive models. What was seen up to now, what was seen at the last change, and the part of a weight that all
  // models share; models are built when they are first used after a change.
  const seen = new Uint32Array(isStatic ? 0 : models * ROW), seenBefore = new Uint32Array(seen.length);
  const shared = new Float64Array(alphabet);
  const builtAt = new Int32Array(models).fill(isStatic ? 0 : -1);
  let change = isStatic ? Infinity : 0, changes = 0;

  const shareCounts = () => {
    seenBefore.set(seen);
    let sum = 0;
    for (let token = 0; token < alphabet; token++) {
      let all = 0;
      for (let model = 0; model < models; model++) all += seen[model * ROW + token];
      shared[token] = 1 + 2 * all;
      sum += shared[token];
    }
    for (let token = 0; token < alphabet; token++) shared[token] = Math.floor((1048576 * shared[token]) / sum) + 1;
  };

  /** @param {number} model */
  const buildAdaptive = (model) => {
    const row = model * ROW;
    for (let token = 0; token < alphabet; token++) weights[token] = 65536 * seenBefore[row + token] + shared[token];
    tables.build(model);
    builtAt[model] = changes;
  };

  for (let step = 0; step < steps; step++) {
    if (step === change) {
      shareCounts();
      changes++;
      change += 1 + (step >> 3);
    }
    const active = step < last ? used : used - 1;
    for (let lane = 0, i = step; lane < active; lane++, i += steps) {
      const model = contexts === null ? classOf[lane] : contexts[i] * classes + classOf[lane];
      if (builtAt[model] !== changes) buildAdaptive(model);
      const x = states[lane], low = x & (SCALE - 1), row = model * ROW;
      let at = row + firsts[model * BUCKETS + (low >> BUCKET_BITS)];
      while (sums[at + 1] <= low) at++;
      let next = (Math.imul(sums[at + 1] - sums[at], x >>> SCALE_BITS) + low - sums[at]) | 0;
      if (next >>> 16 === 0) {
        needSound(word < wordsEnd, "a stream ends before its last token");
        next = (next << 16) | data[word] | (data[word + 1] << 8);
        word += 2;
      }
      states[lane] = next;
      const token = at - row;
      tokens[i] = token;
      classOf[lane] = classAfter[token];
      if (!isStatic) seen[at]++;
    }
  }
  needSound(states.every((state) => state === LANE_END), "the end of a stream does not fit its tokens");
  return { tokens, end: word };
};
