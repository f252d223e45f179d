// A stable radix sort: passes of 8 bits over blocks of keys. The first pass takes the keys in reverse order, so that of
// equal keys the one with the larger index comes first, and leaves out those that are SKIPPED.

struct Arguments {
    draw: array<u32, 4>, // of drawIndirect: six vertices for each sorted key
    dispatch: array<u32, 3>, // of dispatchWorkgroupsIndirect: the blocks of the later passes
}

struct Pass {
    shift: u32, // of the digit
    keys: u32, // the number of keys
}

@group(0) @binding(0) var<uniform> step: Pass;
@group(0) @binding(1) var<storage, read> keys: array<u32>;
@group(0) @binding(2) var<storage, read> before: array<vec2u>; // pairs of key and index
@group(0) @binding(3) var<storage, read_write> after: array<vec2u>;
@group(0) @binding(4) var<storage, read_write> starts: array<u32>; // 256 of each block: counts of digits, then places
@group(0) @binding(5) var<storage, read_write> sorted: u32; // the number of keys after the first pass
@group(0) @binding(6) var<storage, read_write> arguments: Arguments;

const SKIPPED = 0xffffffffu;
const THREADS = 256u;
const TILES = 8u; // of THREADS keys in a block

var<workgroup> bins: array<atomic<u32>, THREADS>;
var<workgroup> sums: array<u32, THREADS>;
var<workgroup> masks: array<atomic<u32>, THREADS * 8u>; // of each digit: which threads of the tile have it

fn length() -> u32 {
    return select(sorted, step.keys, step.shift == 0u);
}

// Returns {key, index} at a place, SKIPPED past the end.
fn pair(place: u32) -> vec2u {
    if (place >= length()) {
        return vec2u(SKIPPED);
    }
    if (step.shift == 0u) {
        let index = length() - 1u - place;
        return vec2u(keys[index], index);
    }
    return before[place];
}

fn digit(key: u32) -> u32 {
    return (key >> step.shift) & 255u;
}

// Counts the digits of a block.
@compute @workgroup_size(THREADS)
fn count(@builtin(local_invocation_index) thread: u32, @builtin(workgroup_id) block: vec3u) {
    atomicStore(&bins[thread], 0u);
    workgroupBarrier();
    for (var tile = 0u; tile < TILES; tile++) {
        let key = pair((block.x * TILES + tile) * THREADS + thread).x;
        if (key != SKIPPED) {
            atomicAdd(&bins[digit(key)], 1u);
        }
    }
    workgroupBarrier();
    starts[block.x * THREADS + thread] = atomicLoad(&bins[thread]);
}

// Turns the counts of all blocks into the places where their keys begin. A thread has a digit.
@compute @workgroup_size(THREADS)
fn scan(@builtin(local_invocation_index) thread: u32) {
    let blocks = (length() + TILES * THREADS - 1u) / (TILES * THREADS);
    var sum = 0u;
    for (var block = 0u; block < blocks; block++) {
        sum += starts[block * THREADS + thread];
    }
    sums[thread] = sum;
    for (var reach = 1u; reach < THREADS; reach *= 2u) {
        workgroupBarrier();
        var earlier = 0u;
        if (thread >= reach) {
            earlier = sums[thread - reach];
        }
        workgroupBarrier();
        sums[thread] += earlier;
    }
    var place = sums[thread] - sum;
    for (var block = 0u; block < blocks; block++) {
        let here = starts[block * THREADS + thread];
        starts[block * THREADS + thread] = place;
        place += here;
    }
    if (thread == THREADS - 1u) {
        sorted = sums[thread];
        arguments.draw = array(6u * sorted, 1u, 0u, 0u);
        arguments.dispatch = array((sorted + TILES * THREADS - 1u) / (TILES * THREADS), 1u, 1u);
    }
}

// Moves the keys of a block to their places.
@compute @workgroup_size(THREADS)
fn scatter(@builtin(local_invocation_index) thread: u32, @builtin(workgroup_id) block: vec3u) {
    let word = thread / 32u;
    let bit = 1u << (thread % 32u);
    sums[thread] = starts[block.x * THREADS + thread];
    for (var tile = 0u; tile < TILES; tile++) {
        for (var k = 0u; k < 8u; k++) {
            atomicStore(&masks[thread * 8u + k], 0u);
        }
        workgroupBarrier();
        let own = pair((block.x * TILES + tile) * THREADS + thread);
        let at = digit(own.x) * 8u;
        if (own.x != SKIPPED) {
            atomicOr(&masks[at + word], bit);
        }
        workgroupBarrier();
        if (own.x != SKIPPED) {
            var rank = countOneBits(atomicLoad(&masks[at + word]) & (bit - 1u));
            for (var k = 0u; k < word; k++) {
                rank += countOneBits(atomicLoad(&masks[at + k]));
            }
            after[sums[digit(own.x)] + rank] = own;
        }
        workgroupBarrier();
        for (var k = 0u; k < 8u; k++) {
            sums[thread] += countOneBits(atomicLoad(&masks[thread * 8u + k]));
        }
    }
}
