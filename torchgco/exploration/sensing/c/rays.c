/* Distances along rays to the first of the bodies of a world: boxes that may be turned and rounded (spheres and capsules
 * are boxes with sides of length 0), and the occupied cells of a grid.
 *
 * The distance of a point from a convex body is a convex function along a ray, so Newton's method from a point before
 * the body never passes the surface, and a slope that isn't negative shows that the ray misses.
 */

#include <math.h>
#include <stdint.h>

#define NUMBERS 16 /* of a box: centre (3), directions of its sides as rows (9), half their lengths (3), radius */
#define NEWTON 80
#define NEAR 1e-9 /* m */

/* enter (rays): where rays o + t d (in the box's frame, d by axes) enter the box with faces `half` + r from its middle, t
 * within [0, range]; infinite where they miss it. Rays are side by side, so that a compiler can take some at a time. */
static void enters(
    int64_t rays, const double *o, const double *restrict d, const double *half, double r, double range,
    double *restrict enter, double *restrict leave) {
    for (int64_t k = 0; k < rays; k++) enter[k] = 0.0, leave[k] = range;
    for (int i = 0; i < 3; i++) {
        double reach = half[i] + r, first = -reach - o[i], second = reach - o[i];
        double beside = fabs(o[i]) > reach ? INFINITY : -INFINITY;
        const double *along = d + i * rays;
        for (int64_t k = 0; k < rays; k++) {
            double size = fabs(along[k]), a = first / along[k], b = second / along[k];
            double low = a < b ? a : b, high = a < b ? b : a;
            low = size < 1e-12 ? beside : low, high = size < 1e-12 ? INFINITY : high;
            enter[k] = low > enter[k] ? low : enter[k], leave[k] = high < leave[k] ? high : leave[k];
        }
    }
    for (int64_t k = 0; k < rays; k++) enter[k] = enter[k] > leave[k] ? INFINITY : enter[k];
}

/* Where the ray o + t d meets the box rounded by r > 0, from t on, where it enters the box with larger sides. */
static double meets(const double *o, const double *d, const double *half, double r, double t, double far) {
    for (int n = 0; n < NEWTON && t <= far; n++) {
        double square = 0.0, slope = 0.0;
        for (int i = 0; i < 3; i++) {
            double p = o[i] + t * d[i], away = p > half[i] ? p - half[i] : p < -half[i] ? p + half[i] : 0.0;
            square += away * away, slope += away * d[i];
        }
        double length = sqrt(square), gap = length - r;
        if (gap <= NEAR) return t;
        if (slope >= 0.0) return INFINITY;
        t += gap * length / -slope;
    }
    return INFINITY;
}

static double first_cell(
    const double *o, const double *d, double far, const int64_t *shape, const uint8_t *occupied, const double *corner,
    double size) {
    double enter = 0.0, leave = far, wait[3], per[3];
    int64_t cell[3], step[3];
    for (int i = 0; i < 3; i++) {
        double low = corner[i] - o[i], high = low + shape[i] * size;
        if (fabs(d[i]) < 1e-12) {
            if (low > 0.0 || high < 0.0) return INFINITY;
            continue;
        }
        double a = low / d[i], b = high / d[i];
        enter = fmax(enter, fmin(a, b)), leave = fmin(leave, fmax(a, b));
    }
    if (enter > leave) return INFINITY;
    for (int i = 0; i < 3; i++) {
        double place = (o[i] + enter * d[i] - corner[i]) / size;
        int64_t at = (int64_t)floor(place);
        cell[i] = at < 0 ? 0 : at >= shape[i] ? shape[i] - 1 : at;
        step[i] = d[i] > 0 ? 1 : -1;
        per[i] = fabs(d[i]) < 1e-12 ? INFINITY : size / fabs(d[i]);
        double edge = corner[i] + (cell[i] + (d[i] > 0)) * size;
        wait[i] = fabs(d[i]) < 1e-12 ? INFINITY : (edge - o[i]) / d[i];
    }
    double t = enter;
    while (t <= leave) {
        if (occupied[(cell[0] * shape[1] + cell[1]) * shape[2] + cell[2]]) return t;
        int i = wait[0] < wait[1] ? (wait[0] < wait[2] ? 0 : 2) : (wait[1] < wait[2] ? 1 : 2);
        t = wait[i], wait[i] += per[i], cell[i] += step[i];
        if (cell[i] < 0 || cell[i] >= shape[i]) return INFINITY;
    }
    return INFINITY;
}

/* distance (rays): to the first body within `range`, infinite where there is none, 0 inside of a body. scratch holds 8
 * numbers for each ray. */
void tgco_cast(
    int64_t rays, const double *origin, const double *directions, double range, int64_t boxes, const double *box,
    const int64_t *shape, const uint8_t *occupied, const double *corner, double size, double *scratch,
    double *distance) {
    double *enter = scratch, *leave = enter + rays, *by_axis = leave + rays, *turned = by_axis + 3 * rays;
    for (int64_t k = 0; k < rays; k++) {
        distance[k] = INFINITY;
        for (int i = 0; i < 3; i++) by_axis[i * rays + k] = directions[3 * k + i];
    }
    for (int64_t j = 0; j < boxes; j++) {
        const double *b = box + j * NUMBERS, *axes = b + 3, *half = b + 12, *own = by_axis;
        double o[3], reach = b[15], gap = 0.0;
        for (int i = 0; i < 3; i++) {
            o[i] = 0.0;
            for (int c = 0; c < 3; c++) o[i] += axes[3 * i + c] * (origin[c] - b[c]);
            double away = fmax(fabs(o[i]) - half[i], 0.0);
            gap += away * away;
        }
        if (sqrt(gap) - reach > range) continue;
        int straight = axes[0] == 1.0 && axes[4] == 1.0 && axes[8] == 1.0;
        for (int i = 0; i < 3 && !straight; i++)
            for (int64_t k = 0; k < rays; k++)
                turned[i * rays + k] = axes[3 * i] * directions[3 * k] + axes[3 * i + 1] * directions[3 * k + 1] +
                                       axes[3 * i + 2] * directions[3 * k + 2];
        if (!straight) own = turned;
        enters(rays, o, own, half, reach, range, enter, leave);
        for (int64_t k = 0; k < rays; k++) {
            if (!(enter[k] < distance[k])) continue;
            double d[3] = {own[k], own[rays + k], own[2 * rays + k]}, far = distance[k] < range ? distance[k] : range;
            double t = reach == 0.0 ? enter[k] : meets(o, d, half, reach, enter[k], far);
            if (t < distance[k]) distance[k] = t;
        }
    }
    if (shape[0] * shape[1] * shape[2] == 0) return;
    for (int64_t k = 0; k < rays; k++) {
        double far = distance[k] < range ? distance[k] : range;
        double t = first_cell(origin, directions + 3 * k, far, shape, occupied, corner, size);
        if (t < distance[k]) distance[k] = t;
    }
}
