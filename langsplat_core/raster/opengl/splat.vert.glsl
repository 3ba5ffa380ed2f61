// One quad per Gaussian, oriented along its footprint and just large enough for the alpha = alpha_min
// contour, cut to what the image can see (a needle may be a million pixels long).
// The host defines VALUES (number of images), EACH_VALUE(DO), which is DO(0) DO(1) ... for all of them, and
// DEPTH (0 or 1). No loop: WebGL 2 wants constant indices of samplers and of images.

uniform sampler2D placement;  // as written by project.frag.glsl
uniform sampler2D shape;
uniform int columns;          // Gaussians per texture row
uniform vec2 image_size;      // px
uniform float alpha_min;

in int gaussian;              // per instance, back to front

flat out vec2 mean;
flat out vec4 footprint;
flat out float opacity;
#if VALUES > 0
uniform sampler2D values[VALUES];
flat out vec3 value[VALUES];
#endif
#if DEPTH
flat out float depth;
#endif

void main() {
    ivec2 texel = ivec2(gaussian % columns, gaussian / columns);
    vec4 place = texelFetch(placement, texel, 0);
    footprint = texelFetch(shape, texel, 0);
    mean = place.xy;
    opacity = place.w;
#if VALUES > 0
#define FETCH(i) value[i] = texelFetch(values[i], texel, 0).rgb;
    EACH_VALUE(FETCH)
#endif
#if DEPTH
    depth = place.z;
#endif

    vec2 along = footprint.xy;
    vec2 across = vec2(-along.y, along.x);
    vec2 centre = 0.5 * image_size;
    vec2 from_mean = vec2(dot(along, centre - mean), dot(across, centre - mean));
    vec2 reach = sqrt(2.0 * log(max(opacity / alpha_min, 1.0))) / footprint.zw;
    float half_diagonal = 0.5 * length(image_size) + 1.0;
    vec2 low = max(-reach, from_mean - half_diagonal);
    vec2 high = min(reach, from_mean + half_diagonal);
    if (opacity == 0.0 || !all(lessThanEqual(low, high))) {  // also where something is NaN
        gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
        return;
    }
    // Slack for rounding: the fragment shader cuts exactly, the quad must only not cut before it.
    vec2 slack = 0.01 + 1e-6 * abs(from_mean);
    vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1);
    vec2 offset = mix(low - slack, high + slack, corner) - from_mean;  // from the image's centre
    vec2 pixel = offset.x * along + offset.y * across;
    gl_Position = vec4(2.0 * pixel / image_size, 0.0, 1.0);
}
