// From channels to an image; composing.py beside it does the same on the CPU and a test compares the two.
// Channels are premultiplied by alpha, row 0 is the top row. Names in capitals are defined from displays.py;
// SHOWN is all drawings as one expression.

uniform sampler2D colours;      // rgb, alpha
uniform sampler2D extra;        // latent colours, alpha; one query per channel (0: none), alpha; or
                                // sum of weight * camera z, alpha
uniform sampler2D selection;    // 1 for what is selected, alpha
uniform bool has_selection;
uniform sampler2D colour_maps;  // MAP_NODES x maps
uniform int colour_map;         // row of the one in use
uniform vec3 query_colours[MAX_QUERIES];

uniform int display;            // number of the display's drawing
uniform vec2 ranges[MAX_QUERIES];  // per component of the further channel, the values drawn as 0 and as 1
uniform bool own_colours;       // heat in the colour of each query instead of the colour map
uniform float heat_opacity;
uniform float dim;
uniform float threshold;
uniform float alpha_gate;
uniform vec3 background;
uniform bool transparent;       // no background, alpha as a fourth channel, colours not premultiplied

in vec2 uv;
out vec4 picture;

vec3 oklab(vec3 colour) {  // squares stand for sRGB's curve
    vec3 c = colour * colour;
    vec3 cones = vec3(dot(c, vec3(0.4122215, 0.5363325, 0.0514460)), dot(c, vec3(0.2119035, 0.6806995, 0.1073970)),
                      dot(c, vec3(0.0883025, 0.2817188, 0.6299787)));
    vec3 roots = pow(max(cones, vec3(0.0)), vec3(1.0 / 3.0));
    return vec3(dot(roots, vec3(0.2104543, 0.7936178, -0.0040720)), dot(roots, vec3(1.9779985, -2.4285922, 0.4505937)),
                dot(roots, vec3(0.0259040, 0.7827718, -0.8086758)));
}

// A colour of OKLab with most of the lightness of another: the cube root of its luminance.
vec3 shaded(vec3 lab, vec3 base) {
    float own = pow(dot(base * base, vec3(0.2126, 0.7152, 0.0722)), 1.0 / 3.0);
    lab.x = mix(own, lab.x, HEAT_LIGHTNESS);
    vec3 roots = vec3(dot(lab, vec3(1.0, 0.3963378, 0.2158038)), dot(lab, vec3(1.0, -0.1055613, -0.0638542)),
                      dot(lab, vec3(1.0, -0.0894842, -1.2914855)));
    vec3 cones = roots * roots * roots;
    return sqrt(clamp(vec3(dot(cones, vec3(4.0767417, -3.3077116, 0.2309699)),
                           dot(cones, vec3(-1.2684380, 2.6097574, -0.3413194)),
                           dot(cones, vec3(-0.0041961, -0.7034186, 1.7076147))), 0.0, 1.0));
}

vec3 mapped(float t, bool lab) {
    float position = clamp(t, 0.0, 1.0) * float(MAP_NODES - 1);
    int low = min(int(position), MAP_NODES - 2);
    // Two fetches, not a filtered lookup: filters round the fraction to 8 bits.
    vec3 first = texelFetch(colour_maps, ivec2(low, colour_map), 0).rgb;
    vec3 second = texelFetch(colour_maps, ivec2(low + 1, colour_map), 0).rgb;
    return lab ? mix(oklab(first), oklab(second), position - float(low)) : mix(first, second, position - float(low));
}

// 1 for each component of a layer whose mean is at least `least`.
vec3 inside(sampler2D layer, ivec2 pixel, float least) {
    vec4 sums = texelFetch(layer, clamp(pixel, ivec2(0), textureSize(layer, 0) - 1), 0);
    return step(least * sums.a, sums.rgb) * float(sums.a > alpha_gate);
}

// True for a pixel inside that has a pixel outside nearby.
bool on_edge(sampler2D layer, vec2 place, float least) {
    ivec2 pixel = ivec2(place * vec2(textureSize(layer, 0)));
    vec3 around = inside(layer, pixel + ivec2(0, EDGE_PX), least) * inside(layer, pixel - ivec2(0, EDGE_PX), least) *
                  inside(layer, pixel + ivec2(EDGE_PX, 0), least) * inside(layer, pixel - ivec2(EDGE_PX, 0), least);
    vec3 edges = inside(layer, pixel, least) * (1.0 - around);
    return max(edges.r, max(edges.g, edges.b)) > 0.0;
}

// The query that a pixel shows: those with at least `least` alternate in stripes; else that of the largest value.
int query_of(vec3 values, vec2 place, float least) {
    ivec2 pixel = ivec2(place * vec2(textureSize(extra, 0)));
    int count = 0;
    int found = 0;
    for (int j = 0; j < MAX_QUERIES; ++j) {
        count += int(values[j] >= least);
        found = abs(values[j]) > abs(values[found]) ? j : found;
    }
    int left = count > 1 ? (pixel.x + pixel.y) / STRIPE_PX % count : -1;
    for (int j = 0; j < MAX_QUERIES; ++j)
        if (values[j] >= least && left-- == 0)
            found = j;
    return found;
}

vec3 heat_map(vec3 base, vec3 values, vec2 place) {
    int query = query_of(values, place, HEAT_EDGE);
    float value = values[query];
    vec2 range = ranges[query];
    float heat = clamp((value - range.x) / (range.y - range.x), 0.0, 1.0);
    vec3 hot = own_colours ? oklab(query_colours[query]) : mapped(heat, true);
    float shown = smoothstep(0.0, 1.0, value < 0.0 ? heat / HEAT_FADE : value / HEAT_BASE);
    if (own_colours)
        shown *= 0.5 + 0.5 * heat;
    return mix(base * dim, shaded(hot, base), heat_opacity * shown);
}

vec3 segments(vec3 base, vec3 values, vec2 place) {
    int winner = query_of(values, place, threshold);
    vec2 range = ranges[winner];
    float opacity = SEGMENT_OPACITY * clamp((1.0 - range.x) / (range.y - range.x), 0.0, 1.0);
    return values[winner] > threshold ? mix(base, query_colours[winner], opacity) : base * dim;
}

vec4 depth_map(vec2 sums) {
    vec2 range = ranges[0];
    float t = (sums.r / max(sums.g, 1e-9) - range.x) / max(range.y - range.x, 1e-9);
    vec3 backdrop = transparent ? vec3(0.0) : background;
    return sums.g > alpha_gate ? vec4(mapped(1.0 - clamp(t, 0.0, 1.0), false), 1.0) : vec4(backdrop, 0.0);
}

void main() {
    vec2 place = vec2(uv.x, 1.0 - uv.y);
    vec4 c = texture(colours, place);
    vec4 sums = texture(extra, place);
    vec3 uncovered = transparent ? vec3(0.0) : (1.0 - c.a) * background;
    float share = transparent ? max(c.a, LEAST_ALPHA) : 1.0;
    vec3 base = clamp(c.rgb / share + uncovered, 0.0, 1.0);
    vec3 mean = sums.a > alpha_gate ? sums.rgb / sums.a : vec3(0.0);
    vec4 shown = SHOWN;
    if (has_selection && inside(selection, ivec2(place * vec2(textureSize(selection, 0))), threshold).r > 0.0)
        shown.rgb = mix(shown.rgb, SELECTED, on_edge(selection, place, threshold) ? 1.0 : SELECTED_OPACITY);
    picture = vec4(clamp(shown.rgb, 0.0, 1.0), transparent ? shown.a : 1.0);
}
