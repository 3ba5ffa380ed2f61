// Draw order on the device: radix sort of camera z, far ones first, 8 bits a pass, least significant first.
//
// The host defines STEP, and GROUP and ROUNDS: a workgroup of GROUP threads takes GROUP * ROUNDS items. One
// thread stands for one digit, so GROUP is 256. No subgroup operations: not every driver of OpenGL 4.3 has them.

layout(local_size_x = GROUP) in;

#define KEYS 0     // once: the key of every Gaussian
#define COUNT 1    // each pass: how often each workgroup meets each digit
#define SCAN 2     // each pass: those counts summed over the workgroups before
#define SCATTER 3  // each pass: every item to its place

layout(std430, binding = 0) readonly buffer Means { double means[]; };  // x, y, z of each Gaussian, world units
layout(std430, binding = 1) buffer KeysIn { uvec2 keys_in[]; };         // low and high half
layout(std430, binding = 2) buffer RowsIn { uint rows_in[]; };
layout(std430, binding = 3) writeonly buffer KeysOut { uvec2 keys_out[]; };
layout(std430, binding = 4) writeonly buffer RowsOut { uint rows_out[]; };
layout(std430, binding = 5) buffer Counts { uint counts[]; };  // digit * workgroups + workgroup
layout(std430, binding = 6) buffer Totals { uint totals[]; };  // of each digit
layout(std430, binding = 7) buffer Command { uint command[]; };  // of the draw: vertices, instances, 0, 0

uniform uint items;
uniform uint groups;  // that share the items

#if STEP == KEYS

uniform dvec4 plane;  // camera z of a point p is dot(plane.xyz, p) + plane.w
uniform double near;
uniform double far;

shared uint drawn;

void main() {
    if (gl_LocalInvocationIndex == 0u)
        drawn = 0u;
    barrier();
    uint place = gl_GlobalInvocationID.x;
    if (place < items) {
        uint row = items - 1u - place;  // of equal depths the later row is farther
        // Rounded after every operation, as the reference does: the order is then the same to the last bit.
        precise double z = means[3u * row] * plane.x;
        precise double y_part = means[3u * row + 1u] * plane.y;
        precise double z_part = means[3u * row + 2u] * plane.z;
        z = z + y_part;
        z = z + z_part;
        z = z + plane.w;
        if (z == 0.0lf)
            z = 0.0lf;  // not -0
        // Ascending keys are descending depths; what is not drawn comes last.
        uvec2 key = uvec2(0xffffffffu);
        if (z > near && z <= far) {
            uvec2 bits = unpackDouble2x32(z);
            bool negative = (bits.y & 0x80000000u) != 0u;
            key = negative ? bits : uvec2(~bits.x, ~bits.y & 0x7fffffffu);
            atomicAdd(drawn, 1u);
        }
        keys_in[place] = key;
        rows_in[place] = row;
    }
    barrier();
    if (gl_LocalInvocationIndex == 0u)
        atomicAdd(command[1], drawn);
}

#else

uniform uint digit_word;   // half of the key that holds this pass's digit
uniform uint digit_shift;  // bits

uint digit_of(uvec2 key) {
    return (key[digit_word] >> digit_shift) & 255u;
}

shared uint sums[GROUP];

// Sum of `value` over the threads before this one; `total` over all. Called by every thread.
uint sum_before(uint value, out uint total) {
    uint thread = gl_LocalInvocationIndex;
    sums[thread] = value;
    barrier();
    for (uint reach = 1u; reach < GROUP; reach *= 2u) {
        uint before = thread >= reach ? sums[thread - reach] : 0u;
        barrier();
        sums[thread] += before;
        barrier();
    }
    uint inclusive = sums[thread];
    total = sums[GROUP - 1];
    barrier();
    return inclusive - value;
}

#if STEP == COUNT

shared uint found[GROUP];

void main() {
    uint thread = gl_LocalInvocationIndex;
    found[thread] = 0u;
    barrier();
    uint first = gl_WorkGroupID.x * GROUP * ROUNDS;
    for (uint round = 0u; round < ROUNDS; ++round) {
        uint item = first + round * GROUP + thread;
        if (item < items)
            atomicAdd(found[digit_of(keys_in[item])], 1u);
    }
    barrier();
    counts[thread * groups + gl_WorkGroupID.x] = found[thread];
}

#elif STEP == SCAN

void main() {  // a workgroup per digit
    uint before = 0u;
    for (uint first = 0u; first < groups; first += GROUP) {
        uint group = first + gl_LocalInvocationIndex;
        uint at = gl_WorkGroupID.x * groups + group;
        uint total;
        uint place = sum_before(group < groups ? counts[at] : 0u, total);
        if (group < groups)
            counts[at] = before + place;
        before += total;
    }
    if (gl_LocalInvocationIndex == 0u)
        totals[gl_WorkGroupID.x] = before;
}

#elif STEP == SCATTER

#define WORDS (GROUP / 32)

shared uint next[GROUP];             // where the next item of each digit goes
shared uint holders[WORDS * GROUP];  // for each digit a bit per thread: does it hold that digit?

void main() {
    uint thread = gl_LocalInvocationIndex;
    uint word = thread / 32u, bit = thread % 32u;
    uint all;
    uint smaller = sum_before(totals[thread], all);
    next[thread] = smaller + counts[thread * groups + gl_WorkGroupID.x];
    for (uint w = 0u; w < WORDS; ++w)
        holders[w * GROUP + thread] = 0u;
    barrier();
    uint first = gl_WorkGroupID.x * GROUP * ROUNDS;
    for (uint round = 0u; round < ROUNDS; ++round) {
        uint item = first + round * GROUP + thread;
        uvec2 key = uvec2(0u);
        uint digit = 0u;
        if (item < items) {
            key = keys_in[item];
            digit = digit_of(key);
            atomicOr(holders[word * GROUP + digit], 1u << bit);
        }
        barrier();
        if (item < items) {  // stable: behind the threads before this one that hold the same digit
            uint place = next[digit] + bitCount(holders[word * GROUP + digit] & ((1u << bit) - 1u));
            for (uint w = 0u; w < word; ++w)
                place += bitCount(holders[w * GROUP + digit]);
            keys_out[place] = key;
            rows_out[place] = rows_in[item];
        }
        barrier();
        for (uint w = 0u; w < WORDS; ++w) {  // here a thread stands for a digit
            next[thread] += bitCount(holders[w * GROUP + thread]);
            holders[w * GROUP + thread] = 0u;
        }
        barrier();
    }
}

#endif
#endif
