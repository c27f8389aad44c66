/* Convex parts of known free space around points, and how far trajectories are from what isn't known to be free. */

#include <math.h>
#include <stdint.h>

/* The vector from the nearest point of a cell's cube to p; its length. */
static inline double from_cube(const double *p, const double *center, double half, double *v) {
    double square = 0.0;
    for (int i = 0; i < 3; i++) {
        double a = p[i] - center[i];
        v[i] = a > half ? a - half : a < -half ? a + half : 0.0;
        square += v[i] * v[i];
    }
    return sqrt(square);
}

static inline int blocked(const int64_t *shape, const uint8_t *state, int64_t kinds, int64_t x, int64_t y, int64_t z) {
    if (x < 0 || y < 0 || z < 0 || x >= shape[0] || y >= shape[1] || z >= shape[2]) return 1;
    return (kinds >> state[(x * shape[1] + y) * shape[2] + z]) & 1;
}

/* The centres of the blocked cells in a window that aren't within other blocked ones, behind which they would be; how
 * many there are. layers (X + 1): how many lie before each layer of the window along x, and in all. */
static int64_t gather(
    const int64_t *shape, const double *corner, double size, const uint8_t *state, int64_t kinds, const int64_t *low,
    const int64_t *high, double *centers, int64_t *layers) {
    int64_t count = 0, Y = shape[1], Z = shape[2], X = shape[0];
    for (int64_t x = low[0]; x <= high[0]; x++) {
        layers[x - low[0]] = count;
        for (int64_t y = low[1]; y <= high[1]; y++) {
            const uint8_t *row = state + (x * Y + y) * Z;
            int inner = x > 0 && y > 0 && x < X - 1 && y < Y - 1;
            for (int64_t z = low[2]; z <= high[2]; z++) {
                if (!((kinds >> row[z]) & 1)) continue;
                if (inner && z > 0 && z < Z - 1) {
                    const uint8_t *c = row + z;
                    int around = ((kinds >> c[1]) & (kinds >> c[-1]) & (kinds >> c[Z]) & (kinds >> c[-Z]) &
                                  (kinds >> c[Y * Z]) & (kinds >> c[-Y * Z])) & 1;
                    if (around) continue;
                }
                double *c = centers + 3 * count++;
                c[0] = corner[0] + (x + 0.5) * size, c[1] = corner[1] + (y + 0.5) * size;
                c[2] = corner[2] + (z + 0.5) * size;
            }
        }
    }
    layers[high[0] - low[0] + 1] = count;
    return count;
}

/* Half-spaces n . x >= b around each of some points that hold all blocked cubes within `reach` of it on their other
 * side. planes (points, most, 4): n and b, zeros where fewer are needed. Each plane touches the nearest cube that none
 * before it has cut off. room (points): how far the point may move in any direction before a cube counts that no plane
 * cuts off, m. low, high: the cells that all of them lie in. scratch holds 7 numbers for each of these cells, and 4;
 * layers one for each of their layers along x, and 1. */
int64_t tgco_corridor(
    const int64_t *shape, const double *corner, double size, const uint8_t *state, int64_t kinds, double reach,
    int64_t points, const double *p, int64_t most, const int64_t *low, const int64_t *high, double *planes,
    double *room, double *scratch, int64_t *layers) {
    double half = 0.5 * size;
    int64_t all = gather(shape, corner, size, state, kinds, low, high, scratch, layers);
    double *own = scratch + 3 * all; /* of each cube near a point: its centre, and the square of its distance */
    for (int64_t k = 0; k < points; k++) {
        const double *q = p + 3 * k;
        double near = floor((q[0] - reach - corner[0]) / size) - low[0];
        double far = floor((q[0] + reach - corner[0]) / size) - low[0];
        int64_t count = 0, last = high[0] - low[0];
        int64_t begin = layers[near < 0 ? 0 : near > last ? last + 1 : (int64_t)near];
        int64_t end = layers[far < 0 ? 0 : far > last ? last + 1 : (int64_t)far + 1];
        for (int64_t j = begin; j < end; j++) {
            const double *c = scratch + 3 * j;
            double square = 0.0;
            for (int i = 0; i < 3; i++) {
                double away = fmax(fabs(q[i] - c[i]) - half, 0.0);
                square += away * away;
            }
            double *to = own + 4 * count; /* a cube that is too far is overwritten by the next one */
            to[0] = c[0], to[1] = c[1], to[2] = c[2], to[3] = square;
            /* No plane parts a point from a cube that it lies in. */
            count += (square <= reach * reach) & (square >= 1e-18);
        }
        room[k] = reach;
        for (int64_t m = 0; m <= most && count > 0; m++) {
            double least = INFINITY, n[3], *plane = planes + (k * most + m) * 4;
            int64_t best = 0, left = 0;
            for (int64_t j = 0; j < count; j++)
                if (own[4 * j + 3] < least) least = own[4 * j + 3], best = j;
            double nearest = from_cube(q, own + 4 * best, half, n);
            if (m == most) {
                room[k] = nearest;
                break;
            }
            double b = -nearest;
            for (int i = 0; i < 3; i++) n[i] /= nearest, plane[i] = n[i], b += n[i] * q[i];
            plane[3] = b;
            double wide = half * (fabs(n[0]) + fabs(n[1]) + fabs(n[2])) - 1e-6;
            for (int64_t j = 0; j < count; j++) {
                double c[4] = {own[4 * j], own[4 * j + 1], own[4 * j + 2], own[4 * j + 3]}, *to = own + 4 * left;
                for (int i = 0; i < 4; i++) to[i] = c[i];
                left += n[0] * c[0] + n[1] * c[1] + n[2] * c[2] + wide > b;
            }
            count = left;
        }
    }
    return 0;
}

/* Distances (points), m, from points to the nearest blocked cube within `reach`, else reach; what lies outside of the
 * grid is blocked. */
int64_t tgco_gaps(
    const int64_t *shape, const double *corner, double size, const uint8_t *state, int64_t kinds, double reach,
    int64_t points, const double *p, double *gap) {
    int64_t wide = (int64_t)ceil(reach / size), Y = shape[1], Z = shape[2];
    for (int64_t k = 0; k < points; k++) {
        const double *q = p + 3 * k;
        int64_t c[3];
        double v[3], least = reach;
        int in = 1, inner = 1;
        for (int i = 0; i < 3; i++) {
            double at = floor((q[i] - corner[i]) / size);
            in &= at >= 0.0 && at < shape[i];
            inner &= at >= wide && at < shape[i] - wide;
            c[i] = in ? (int64_t)at : 0;
        }
        if (!in) {
            gap[k] = 0.0;
            continue;
        }
        for (int64_t x = c[0] - wide; x <= c[0] + wide; x++)
            for (int64_t y = c[1] - wide; y <= c[1] + wide; y++) {
                if (inner) { /* rows without a blocked cell */
                    const uint8_t *row = state + (x * Y + y) * Z + c[2] - wide;
                    int64_t any = 0;
                    for (int64_t z = 0; z <= 2 * wide; z++) any |= kinds >> row[z];
                    if (!(any & 1)) continue;
                }
                for (int64_t z = c[2] - wide; z <= c[2] + wide; z++) {
                    if (!blocked(shape, state, kinds, x, y, z)) continue;
                    double center[3] = {corner[0] + (x + 0.5) * size, corner[1] + (y + 0.5) * size,
                                        corner[2] + (z + 0.5) * size};
                    double d = from_cube(q, center, 0.5 * size, v);
                    least = d < least ? d : least;
                }
            }
        gap[k] = least;
    }
    return 0;
}
