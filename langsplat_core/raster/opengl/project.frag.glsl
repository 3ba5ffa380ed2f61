// Steps 1 and 2 of raster/reference.py: one fragment projects one Gaussian, once per view.
//
// A fragment pass instead of the splats' vertex shader, because that would repeat the work for each of
// the four corners and fetch the coefficients in depth order, all over memory; OpenGL 4.1 has no compute.

uniform sampler2DArray gaussians;  // layer 0: mean, opacity; 1: scales; 2: unit quaternion wxyz
uniform sampler2DArray sh;         // coefficients k, channels rgb, packed four floats to a texel

uniform mat3 world_to_camera;
uniform vec3 camera_high;  // camera position rounded to float32 ...
uniform vec3 camera_low;   // ... and the rest: scenes may lie a million units from the origin
uniform bool orthographic;
uniform vec2 focal;        // px; orthographic: px per world unit
uniform vec2 principal;    // px
uniform vec4 tangents;     // clamp of x/z and y/z: left, top, right, bottom
uniform float dilation;    // px^2
uniform float fitted;      // part of it that opacities were fitted with
uniform float alpha_min;
uniform float colour_max;  // largest number of the image
uniform int sh_count;      // 1, 4, 9 or 16

layout(location = 0) out vec4 placement;  // mean in px, camera z, opacity (0: not drawn)
layout(location = 1) out vec4 shape;      // long axis (unit vector), 1 / standard deviation along and across, 1/px
layout(location = 2) out vec4 colour;     // display colour seen from the camera, 0 to colour_max

// Standard deviations beyond this many pixels look the same; its fourth power still fits a float.
const float LARGEST_PX = 1e9;

vec3 coefficient(ivec2 texel, int k) {
    int first = 3 * k;
    vec3 value;
    for (int c = 0; c < 3; ++c)
        value[c] = texelFetch(sh, ivec3(texel, (first + c) >> 2), 0)[(first + c) & 3];
    return value;
}

// Real spherical harmonics as in scene/transform.py.
vec3 radiance(ivec2 texel, vec3 d) {
    float x = d.x, y = d.y, z = d.z;
    vec3 rgb = 0.5 + 0.28209479177387814 * coefficient(texel, 0);
    if (sh_count > 1) {
        rgb += 0.4886025119029199 * (-y * coefficient(texel, 1) + z * coefficient(texel, 2)
                                     - x * coefficient(texel, 3));
    }
    if (sh_count > 4) {
        rgb += 1.0925484305920792 * (x * y * coefficient(texel, 4) - y * z * coefficient(texel, 5)
                                     - x * z * coefficient(texel, 7));
        rgb += 0.31539156525252005 * (2.0 * z * z - x * x - y * y) * coefficient(texel, 6);
        rgb += 0.5462742152960396 * (x * x - y * y) * coefficient(texel, 8);
    }
    if (sh_count > 9) {
        float xx = x * x, yy = y * y, zz = z * z;
        rgb -= 0.5900435899266435 * (y * (3.0 * xx - yy) * coefficient(texel, 9)
                                     + x * (xx - 3.0 * yy) * coefficient(texel, 15));
        rgb += 2.890611442640554 * x * y * z * coefficient(texel, 10);
        rgb -= 0.4570457994644658 * (4.0 * zz - xx - yy)
               * (y * coefficient(texel, 11) + x * coefficient(texel, 13));
        rgb += 0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * coefficient(texel, 12);
        rgb += 1.445305721320277 * z * (xx - yy) * coefficient(texel, 14);
    }
    return clamp(rgb, 0.0, colour_max);
}

mat3 rotation(vec4 q) {
    float w = q.x, x = q.y, y = q.z, z = q.w;
    return mat3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
                2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
                2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

void main() {
    ivec2 texel = ivec2(gl_FragCoord.xy);
    vec4 mean_opacity = texelFetch(gaussians, ivec3(texel, 0), 0);
    vec3 scales = texelFetch(gaussians, ivec3(texel, 1), 0).xyz;
    mat3 axes = rotation(texelFetch(gaussians, ivec3(texel, 2), 0));

    precise vec3 from_camera = mean_opacity.xyz - camera_high;
    from_camera -= camera_low;
    vec3 p = world_to_camera * from_camera;
    // Gaussians at or behind the near plane are not in the draw list; here they must only stay finite.
    float z = orthographic ? 1.0 : max(p.z, 1e-12);
    vec2 tangent = p.xy / z;
    vec2 clamped = orthographic ? vec2(0.0) : clamp(tangent, -tangents.xy, tangents.zw);

    // Rows of A = J W R diag(s); row vector times matrix.
    vec3 a0 = focal.x / z * ((vec3(1.0, 0.0, -clamped.x) * world_to_camera) * axes) * scales;
    vec3 a1 = focal.y / z * ((vec3(0.0, 1.0, -clamped.y) * world_to_camera) * axes) * scales;
    vec3 keep = LARGEST_PX / max(max(abs(a0), abs(a1)), LARGEST_PX);  // per axis of the Gaussian
    a0 *= keep;
    a1 *= keep;

    float xx = dot(a0, a0), yy = dot(a1, a1), xy = dot(a0, a1);
    vec3 normal = cross(a0, a1);
    float det_sharp = dot(normal, normal);  // Cauchy-Binet: det(A A^T) without cancellation
    float det = det_sharp + dilation * (xx + yy) + dilation * dilation;

    // Eigenvalues: the larger without cancellation, the smaller by the determinant.
    float half_difference = 0.5 * (xx - yy);
    float radius = length(vec2(half_difference, xy));
    float variance_along = 0.5 * (xx + yy) + dilation + radius;
    float variance_across = max(det / variance_along, dilation);
    // Eigenvector by the column in which nothing cancels; any direction does for a circle.
    vec2 along = half_difference >= 0.0 ? vec2(radius + half_difference, xy)
                                        : vec2(xy, radius - half_difference);
    float size = length(along);
    along = size > 0.0 ? along / size : vec2(1.0, 0.0);

    float opacity = mean_opacity.w;
    if (fitted < dilation) {
        float det_fitted = det_sharp + fitted * (xx + yy) + fitted * fitted;
        opacity *= sqrt(max(det_fitted / det, 0.005 * 0.005));
    }
    placement = vec4(focal * tangent + principal, p.z, opacity >= alpha_min ? opacity : 0.0);
    shape = vec4(along, inversesqrt(variance_along), inversesqrt(variance_across));
    vec3 sight = orthographic ? vec3(0.0, 0.0, 1.0) * world_to_camera : from_camera;
    float far = length(sight);
    colour = vec4(radiance(texel, far > 0.0 ? sight / far : vec3(0.0)), 1.0);
}
