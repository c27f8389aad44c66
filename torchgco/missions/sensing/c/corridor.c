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
 * many there are. */
static int64_t gather(
    const int64_t *shape, const double *corner, double size, const uint8_t *state, int64_t kinds, const int64_t *low,
    const int64_t *high, double *centers) {
    int64_t count = 0, Y = shape[1], Z = shape[2], X = shape[0];
    for (int64_t x = low[0]; x <= high[0]; x++)
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
    return count;
}

/* Half-spaces n . x >= b around each of some points that hold all blocked cubes within `reach` of it on their other
 * side. planes (points, most, 4): n and b, zeros where fewer are needed. Each plane touches the nearest cube that none
 * before it has cut off. room (points): how far the point may move in any direction before a cube counts that no plane
 * cuts off, m. low, high: the cells that all of them lie in. scratch holds 6 numbers for each of these cells. */
int64_t tgco_corridor(
    const int64_t *shape, const double *corner, double size, const uint8_t *state, int64_t kinds, double reach,
    int64_t points, const double *p, int64_t most, const int64_t *low, const int64_t *high, double *planes, double *room,
    double *scratch) {
    double half = 0.5 * size, v[3];
    int64_t all = gather(shape, corner, size, state, kinds, low, high, scratch);
    double *own = scratch + 3 * all;
    for (int64_t k = 0; k < points; k++) {
        const double *q = p + 3 * k;
        int64_t count = 0;
        for (int64_t j = 0; j < all; j++) {
            const double *c = scratch + 3 * j;
            if (fabs(c[0] - q[0]) > reach + half || fabs(c[1] - q[1]) > reach + half) continue;
            if (fabs(c[2] - q[2]) > reach + half || from_cube(q, c, half, v) > reach) continue;
            double *to = own + 3 * count++;
            to[0] = c[0], to[1] = c[1], to[2] = c[2];
        }
        room[k] = reach;
        for (int64_t m = 0; m <= most && count > 0; m++) {
            double nearest = INFINITY, n[3] = {0.0, 0.0, 0.0}, *plane = planes + (k * most + m) * 4;
            for (int64_t j = 0; j < count; j++) {
                double d = from_cube(q, own + 3 * j, half, v);
                if (d < nearest) {
                    nearest = d;
                    for (int i = 0; i < 3; i++) n[i] = v[i];
                }
            }
            if (nearest < 1e-9) { /* no plane parts a point from the cubes that it lies in: the others count */
                int64_t out = 0;
                for (int64_t j = 0; j < count; j++) {
                    double *c = own + 3 * j, *to = own + 3 * out;
                    if (from_cube(q, c, half, v) < 1e-9) continue;
                    to[0] = c[0], to[1] = c[1], to[2] = c[2], out++;
                }
                count = out, m--;
                continue;
            }
            if (m == most) {
                room[k] = nearest;
                break;
            }
            double b = -nearest;
            for (int i = 0; i < 3; i++) n[i] /= nearest, plane[i] = n[i], b += n[i] * q[i];
            plane[3] = b;
            double wide = half * (fabs(n[0]) + fabs(n[1]) + fabs(n[2])) - 1e-6;
            int64_t left = 0;
            for (int64_t j = 0; j < count; j++) {
                double *c = own + 3 * j, *to = own + 3 * left;
                if (n[0] * c[0] + n[1] * c[1] + n[2] * c[2] + wide <= b) continue;
                to[0] = c[0], to[1] = c[1], to[2] = c[2], left++;
            }
            count = left;
        }
    }
    return 0;
}

/* Distances (points), m, from points to the nearest blocked cube within `reach`, else reach; what lies outside of the
 * grid is blocked. distance (cells), m: of the cells' centres, at most what the map reaches. */
int64_t tgco_gaps(
    const int64_t *shape, const double *corner, double size, const uint8_t *state, int64_t kinds, const float *distance,
    double reach, int64_t points, const double *p, double *gap) {
    int64_t wide = (int64_t)ceil(reach / size);
    for (int64_t k = 0; k < points; k++) {
        const double *q = p + 3 * k;
        int64_t c[3];
        double off = 0.0, v[3], least = reach;
        int in = 1;
        for (int i = 0; i < 3; i++) {
            double at = floor((q[i] - corner[i]) / size), center = corner[i] + (at + 0.5) * size;
            in &= at >= 0.0 && at < shape[i];
            c[i] = (int64_t)at, off += (q[i] - center) * (q[i] - center);
        }
        if (!in) {
            gap[k] = 0.0;
            continue;
        }
        if (distance[(c[0] * shape[1] + c[1]) * shape[2] + c[2]] - sqrt(off) >= reach) {
            gap[k] = reach;
            continue;
        }
        for (int64_t x = c[0] - wide; x <= c[0] + wide; x++)
            for (int64_t y = c[1] - wide; y <= c[1] + wide; y++)
                for (int64_t z = c[2] - wide; z <= c[2] + wide; z++) {
                    if (!blocked(shape, state, kinds, x, y, z)) continue;
                    double center[3] = {corner[0] + (x + 0.5) * size, corner[1] + (y + 0.5) * size,
                                        corner[2] + (z + 0.5) * size};
                    double d = from_cube(q, center, 0.5 * size, v);
                    least = d < least ? d : least;
                }
        gap[k] = least;
    }
    return 0;
}
