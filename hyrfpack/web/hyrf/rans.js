// Decodes streams of tokens (docs/reference/format.md 3.1), which are coded by interleaved rANS.

import { HyrfFormatError, assertValid } from "./errors.js";

const MAX_ALPHABET_TOKENS = 126;
const MAX_MODELS = 1024;
const MAX_LANES_LOG2 = 13;
const MAX_STEPS_PER_LANE = 65536; // not a limit of streams with the largest number of lanes
const MAX_TOKEN_COUNT = 2 ** 31; // keeps all products below 2^53, so that they are exact
const FREQUENCY_BITS = 12;
const FREQUENCY_SUM = 1 << FREQUENCY_BITS; // the sum of the token frequencies of a model
const FINAL_LANE_STATE = 65536; // the state of each lane after its last token
const MAX_WEIGHT_LEVEL = 49;
const WEIGHT_PER_TOKEN = 65536; // of an adaptive model, for each time that the token has occurred
const SHARED_WEIGHT_SUM = 2 ** 20; // about the sum of the weights that all adaptive models share
const MODEL_STRIDE = 128; // entries of a model in the tables: a power of two above the number of tokens
const BUCKET_SIZE_LOG2 = 4; // a lookup table gives the first token of each bucket of positions
const BUCKETS_PER_MODEL = FREQUENCY_SUM >> BUCKET_SIZE_LOG2;

/** The weight for each level of a static model. */
const WEIGHT_BY_LEVEL = [0];
for (let level = 0; level < MAX_WEIGHT_LEVEL; level++) WEIGHT_BY_LEVEL.push((4 + (level % 4)) * 2 ** (level >> 2));

/**
 * Returns the number of contexts, which is the largest context plus 1.
 * @param {Uint8Array | null} contexts
 * @returns {number}
 */
const countContexts = (contexts) => {
  let largest = 0;
  if (contexts) for (let i = 0; i < contexts.length; i++) if (contexts[i] > largest) largest = contexts[i];
  return largest + 1;
};

/**
 * Decodes the tokens at the start of `data`.
 * @param {Uint8Array} data
 * @param {number} count the number of tokens
 * @param {Uint8Array | null} contexts the context of each token; null if there is one context
 * @param {boolean} [mayBeStatic] whether static models are allowed
 * @returns {{tokens: Uint8Array, end: number}} `end` is the number of bytes of the tokens
 * @throws {DamagedData} the stream is damaged
 */
export const decodeTokens = (data, count, contexts, mayBeStatic = true) => {
  if (count === 0) return { tokens: new Uint8Array(0), end: 0 };
  if (count >= MAX_TOKEN_COUNT) {
    throw new HyrfFormatError("The model is too large for this reader; open a smaller one.");
  }
  assertValid(data.length >= 2, "a stream ends within its header");
  const alphabet = data[1], contextCount = countContexts(contexts);
  if (alphabet === 0) return decodeConstantTokens(data, count, contexts, contextCount);
  const lanesLog2 = data[0] & 15, classes = ((data[0] >> 4) & 7) + 1, isStatic = data[0] >= 128;
  const models = contextCount * classes;
  const isInRange = alphabet <= MAX_ALPHABET_TOKENS && models <= MAX_MODELS && lanesLog2 <= MAX_LANES_LOG2;
  assertValid(isInRange && (mayBeStatic || !isStatic), "a stream's header has invalid values");
  const hasEnoughLanes = count <= MAX_STEPS_PER_LANE * 2 ** lanesLog2 || lanesLog2 === MAX_LANES_LOG2;
  assertValid(hasEnoughLanes, "a stream has too few lanes");
  let place = 2 + classes - 1;
  const tokenClasses = classByToken(data.subarray(2, place), alphabet);
  const tables = new ModelTables(models, alphabet);
  if (isStatic) place += readStaticModels(data.subarray(Math.min(place, data.length)), tables);
  return decodeLanes(data, place, count, contexts, classes, tokenClasses, tables, 2 ** lanesLog2, isStatic);
};

/**
 * Decodes a stream in which each context has only one token.
 * @param {Uint8Array} data
 * @param {number} count
 * @param {Uint8Array | null} contexts
 * @param {number} contextCount
 */
const decodeConstantTokens = (data, count, contexts, contextCount) => {
  const end = 2 + contextCount, contextTokens = data.subarray(2, end);
  const areTokensValid =
    data[0] === 0 && contextTokens.length === contextCount &&
    contextTokens.every((token) => token < MAX_ALPHABET_TOKENS);
  assertValid(areTokensValid, "the tokens of a stream's contexts are missing or damaged");
  const tokens = new Uint8Array(count);
  if (contexts && contextCount > 1) for (let i = 0; i < count; i++) tokens[i] = contextTokens[contexts[i]];
  else tokens.fill(contextTokens[0]);
  return { tokens, end };
};

/**
 * Returns, for each token, the class of a lane whose last token it is.
 * @param {Uint8Array} thresholds the first token of each class but the first, in rising order
 * @param {number} alphabet the number of different tokens
 */
const classByToken = (thresholds, alphabet) => {
  const edges = [0, ...thresholds, alphabet];
  const areRising = edges.every((edge, i) => i === 0 || edges[i - 1] < edge);
  assertValid(areRising, "the thresholds of a stream's classes do not rise");
  return Uint8Array.from({ length: alphabet }, (_, token) => thresholds.filter((edge) => edge <= token).length);
};

/** Lookup tables of all models, built from the weights of their tokens. */
class ModelTables {
  /**
   * @param {number} models the number of models
   * @param {number} alphabet the number of different tokens
   */
  constructor(models, alphabet) {
    this.models = models;
    this.alphabet = alphabet;
    /** Cumulative frequencies f_0 + ... + f_(j-1) of the tokens; MODEL_STRIDE entries per model. */
    this.sums = new Uint16Array(models * MODEL_STRIDE);
    /** The token at the first position of each bucket; BUCKETS_PER_MODEL entries per model. */
    this.firsts = new Uint8Array(models * BUCKETS_PER_MODEL);
    /** The weights of one model, which `build` reads. */
    this.weights = new Float64Array(MODEL_STRIDE);
  }

  /**
   * Builds the tables of a model from `weights`. Weights must be below 2^47, so that all numbers stay below 2^53.
   * @param {number} model
   */
  build(model) {
    const { weights, alphabet, sums, firsts } = this;
    let sum = 0, largest = 0;
    for (let token = 0; token < alphabet; token++) {
      sum += weights[token];
      if (weights[token] > weights[largest]) largest = token;
    }
    const row = model * MODEL_STRIDE;
    let rest = FREQUENCY_SUM;
    for (let token = 0; token < alphabet; token++) {
      // floor(4096 w / sum), in two halves of 6 bits.
      const scaled = weights[token] * 64, high = Math.floor(scaled / sum);
      const frequency = 64 * high + Math.floor(((scaled - high * sum) * 64) / sum);
      sums[row + token] = frequency || +(weights[token] > 0);
      rest -= sums[row + token];
    }
    sums[row + largest] += rest;
    const buckets = model * BUCKETS_PER_MODEL;
    let start = 0, bucket = 0;
    for (let token = 0; token < alphabet; token++) {
      const end = start + sums[row + token];
      sums[row + token] = start;
      for (; bucket << BUCKET_SIZE_LOG2 < end; bucket++) firsts[buckets + bucket] = token;
      start = end;
    }
    sums[row + alphabet] = FREQUENCY_SUM;
  }
}

/**
 * Builds static models from their stored levels.
 * @param {Uint8Array} data
 * @param {ModelTables} tables
 * @returns {number} the number of bytes of the levels
 */
const readStaticModels = (data, tables) => {
  const { models, alphabet, weights } = tables;
  const { tokens, end } = decodeTokens(data, models * alphabet, null, false);
  const levels = new Int32Array(alphabet);
  for (let model = 0, at = 0; model < models; model++) {
    let weightSum = 0;
    for (let token = 0; token < alphabet; token++, at++) {
      const difference = (tokens[at] >> 1) ^ -(tokens[at] & 1);
      levels[token] = difference + (model ? levels[token] : token ? levels[token - 1] : 0);
      assertValid(levels[token] >= 0 && levels[token] <= MAX_WEIGHT_LEVEL, "a model has a level out of range");
      weights[token] = WEIGHT_BY_LEVEL[levels[token]];
      weightSum += weights[token];
    }
    assertValid(weightSum > 0, "a model has no frequencies");
    tables.build(model);
  }
  return end;
};

/**
 * Decodes the tokens of interleaved lanes.
 * @param {Uint8Array} data
 * @param {number} place the offset of the lanes' states
 * @param {number} count
 * @param {Uint8Array | null} contexts
 * @param {number} classes the number of classes of lanes
 * @param {Uint8Array} tokenClasses the result of `classByToken`
 * @param {ModelTables} tables
 * @param {number} lanes the number of lanes in the header
 * @param {boolean} isStatic whether the models stay as they are
 */
const decodeLanes = (data, place, count, contexts, classes, tokenClasses, tables, lanes, isStatic) => {
  const { models, alphabet, sums, firsts, weights } = tables;
  const minSteps = Math.ceil(count / lanes), steps = minSteps % 2 ? minSteps : minSteps + 1;
  const usedLanes = Math.ceil(count / steps), lastLaneTokens = count - (usedLanes - 1) * steps;
  let word = place + 4 * usedLanes;
  assertValid(word <= data.length, "a stream ends within the states of its lanes");
  const wordsEnd = word + Math.floor((data.length - word) / 2) * 2;
  const view = new DataView(data.buffer, data.byteOffset, data.length);
  const states = Int32Array.from({ length: usedLanes }, (_, lane) => view.getInt32(place + 4 * lane, true));
  const tokens = new Uint8Array(count);
  const laneClasses = new Uint8Array(usedLanes);

  // Adaptive models are updated at certain steps. `seen` counts the tokens of each model so far, `seenBefore` those up
  // to the last update, and `sharedWeights` are the parts of the weights that all models share. A model is built when
  // it is first used after an update; `builtAt` is the number of updates at that time.
  const seen = new Uint32Array(isStatic ? 0 : models * MODEL_STRIDE), seenBefore = new Uint32Array(seen.length);
  const sharedWeights = new Float64Array(alphabet);
  const builtAt = new Int32Array(models).fill(isStatic ? 0 : -1);
  let nextUpdateStep = isStatic ? Infinity : 0, updates = 0;

  /** Adapts the weights to the tokens so far. */
  const updateWeights = () => {
    seenBefore.set(seen);
    let sum = 0;
    for (let token = 0; token < alphabet; token++) {
      let total = 0;
      for (let model = 0; model < models; model++) total += seen[model * MODEL_STRIDE + token];
      sharedWeights[token] = 1 + 2 * total;
      sum += sharedWeights[token];
    }
    for (let token = 0; token < alphabet; token++) {
      sharedWeights[token] = Math.floor((SHARED_WEIGHT_SUM * sharedWeights[token]) / sum) + 1;
    }
  };

  /**
   * Builds the tables of a model from the weights of the last update.
   * @param {number} model
   */
  const buildAdaptive = (model) => {
    const row = model * MODEL_STRIDE;
    for (let token = 0; token < alphabet; token++) {
      weights[token] = WEIGHT_PER_TOKEN * seenBefore[row + token] + sharedWeights[token];
    }
    tables.build(model);
    builtAt[model] = updates;
  };

  for (let step = 0; step < steps; step++) {
    if (step === nextUpdateStep) {
      updateWeights();
      updates++;
      nextUpdateStep += 1 + (step >> 3);
    }
    const active = step < lastLaneTokens ? usedLanes : usedLanes - 1;
    for (let lane = 0, i = step; lane < active; lane++, i += steps) {
      const model = contexts === null ? laneClasses[lane] : contexts[i] * classes + laneClasses[lane];
      if (builtAt[model] !== updates) buildAdaptive(model);
      const x = states[lane], low = x & (FREQUENCY_SUM - 1), row = model * MODEL_STRIDE;
      let at = row + firsts[model * BUCKETS_PER_MODEL + (low >> BUCKET_SIZE_LOG2)];
      while (sums[at + 1] <= low) at++;
      let next = (Math.imul(sums[at + 1] - sums[at], x >>> FREQUENCY_BITS) + low - sums[at]) | 0;
      if (next >>> 16 === 0) {
        assertValid(word < wordsEnd, "a stream ends before its last token");
        next = (next << 16) | data[word] | (data[word + 1] << 8);
        word += 2;
      }
      states[lane] = next;
      const token = at - row;
      tokens[i] = token;
      laneClasses[lane] = tokenClasses[token];
      if (!isStatic) seen[at]++;
    }
  }
  assertValid(states.every((state) => state === FINAL_LANE_STATE), "the end of a stream does not fit its tokens");
  return { tokens, end: word };
};
