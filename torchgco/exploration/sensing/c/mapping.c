/* The vehicle's map: log-odds of cells updated along rays, and distances from cells to the nearest of a kind. */

#include <math.h>
#include <stdint.h>
#include <stdlib.h>

enum { UNKNOWN = 0, FREE = 1, OCCUPIED = 2 };

typedef struct {
    const int64_t *shape;
    const double *corner;
    double size;
} Grid;

static inline int64_t place(const Grid *g, const int64_t *c) { return (c[0] * g->shape[1] + c[1]) * g->shape[2] + c[2]; }

/* The cell of a point; 0 where it lies outside of the grid. */
static int cell_of(const Grid *g, const double *p, int64_t *c) {
    for (int i = 0; i < 3; i++) {
        double at = floor((p[i] - g->corner[i]) / g->size);
        if (!(at >= 0.0 && at < g->shape[i])) return 0;
        c[i] = (int64_t)at;
    }
    return 1;
}

/* What a cell's count holds within a scan: whether the scan has touched it, how many rays ended in it, and how many
 * passed, at most MOST_RAYS each. Between two scans all counts are 0. */
enum { MOST_RAYS = 16383, PASS = 1, RETURN = 16384, TOUCHED = 1 << 30 };
/* Passes of a scan that count; and passes per return up to which the cell is occupied. Fewer returns are noise of a
 * surface beside it. */
enum { PASSES = 7, PER_RETURN = 8 };

static inline int64_t returns(uint32_t count) { return count / RETURN % RETURN; }
static inline int64_t passes(uint32_t count) { return count % RETURN; }

/* Counts the rays that pass cells: here one, from its origin inside the grid over a length. Of a cell that it only cuts
 * the corner of, for less than `chord`, it shows nothing; nor of the cell `last`, in which it ends. */
static int64_t pass(
    const Grid *g, const double *o, const double *d, double length, double chord, int64_t last, uint32_t *counts,
    int32_t *touched, int64_t count) {
    int64_t c[3], stride[3] = {g->shape[1] * g->shape[2], g->shape[2], 1}, left[3];
    double wait[3], per[3], t = 0.0;
    if (!cell_of(g, o, c)) return count;
    int64_t at = place(g, c);
    for (int i = 0; i < 3; i++) {
        int still = fabs(d[i]) < 1e-12;
        left[i] = d[i] > 0 ? g->shape[i] - 1 - c[i] : c[i], stride[i] = d[i] > 0 ? stride[i] : -stride[i];
        per[i] = still ? INFINITY : g->size / fabs(d[i]);
        wait[i] = still ? INFINITY : (g->corner[i] + (c[i] + (d[i] > 0)) * g->size - o[i]) / d[i];
    }
    double x = wait[0], y = wait[1], z = wait[2];
    while (t < length) { /* no branch depends on the axis: none of them could be foreseen */
        double next = fmin(fmin(x, y), z), end = next < length ? next : length;
        int on_x = x <= next, on_y = !on_x & (y <= next), i = on_x ? 0 : 2 - on_y;
        uint32_t held = counts[at], shown = (end - t >= chord) & (at != last);
        touched[count] = (int32_t)at, count += shown & (held == 0);
        counts[at] = held + shown * ((held == 0 ? TOUCHED : 0) + (passes(held) < MOST_RAYS ? PASS : 0));
        if (left[i]-- == 0) break;
        t = next, at += stride[i];
        x = on_x ? x + per[0] : x, y = on_y ? y + per[1] : y, z = i == 2 ? z + per[2] : z;
    }
    return count;
}

/* Adds `by` to what the up to 26 cells around one count of occupied cells beside them. Adds those that the scan hasn't
 * touched to its list, and returns the list's length. */
static int64_t around(
    const Grid *g, int64_t at, int by, uint8_t *beside, uint32_t *counts, int32_t *touched, int64_t count) {
    int64_t Y = g->shape[1], Z = g->shape[2], c[3] = {at / (Y * Z), at / Z % Y, at % Z};
    for (int64_t x = c[0] - 1; x <= c[0] + 1; x++)
        for (int64_t y = c[1] - 1; y <= c[1] + 1; y++)
            for (int64_t z = c[2] - 1; z <= c[2] + 1; z++) {
                if (x < 0 || y < 0 || z < 0 || x >= g->shape[0] || y >= Y || z >= Z) continue;
                int64_t other = (x * Y + y) * Z + z;
                if (other != at) beside[other] = (uint8_t)(beside[other] + by);
                if (counts[other] == 0) counts[other] = TOUCHED, touched[count++] = (int32_t)other;
            }
    return count;
}

/* Asks the memory for an entry of a list that is soon needed. */
#define AHEAD(of, list, n, all) ((n) + 12 < (all) ? __builtin_prefetch(&(of)[(list)[(n) + 12]], 1) : (void)0)

/* Adds a scan to the map. Cells with returns get `hit`, others `miss` for each ray that passed, up to PASSES of them.
 * A cell is occupied from the odds `occupied` on, free up to `free`, beside an occupied one up to `free_beside`.
 *
 * odds (cells), state (cells); beside (cells): of the 26 cells around each, how many are occupied; counts (cells):
 * zeros. touched (cells + 1) is scratch; changed (cells) gets the cells whose state changed. Returns how many. */
int64_t tgco_add_scan(
    const int64_t *shape, const double *corner, double size, float *odds, uint8_t *state, uint8_t *beside,
    uint32_t *counts, int64_t rays, const double *origin, const double *directions, const double *distances,
    double range, double before, double chord, double hit, double miss, double least, double most, double free, double free_beside,
    double occupied, int32_t *touched, int32_t *changed) {
    Grid g = {shape, corner, size};
    int64_t count = 0, found = 0;
    for (int64_t k = 0; k < rays; k++) {
        if (!isfinite(distances[k])) continue;
        double p[3];
        int64_t c[3];
        for (int i = 0; i < 3; i++) p[i] = origin[i] + distances[k] * directions[3 * k + i];
        if (!cell_of(&g, p, c)) continue;
        int64_t at = place(&g, c);
        if (counts[at] == 0) touched[count++] = (int32_t)at;
        counts[at] = (counts[at] | TOUCHED) + (returns(counts[at]) < MOST_RAYS ? RETURN : 0);
    }
    for (int64_t k = 0; k < rays; k++) {
        double length = range, p[3];
        int64_t last = -1, c[3];
        if (isfinite(distances[k])) {
            length = distances[k] - before;
            for (int i = 0; i < 3; i++) p[i] = origin[i] + distances[k] * directions[3 * k + i];
            if (cell_of(&g, p, c)) last = place(&g, c);
        }
        count = pass(&g, origin, directions + 3 * k, length, chord, last, counts, touched, count);
    }
    for (int64_t n = 0, all = count; n < all; n++) {
        int32_t at = touched[n];
        AHEAD(odds, touched, n, all), AHEAD(counts, touched, n, all);
        int64_t ended = returns(counts[at]), passed = passes(counts[at]);
        int is_hit = ended > 0 && passed <= PER_RETURN * ended, was = odds[at] >= occupied;
        float sum = odds[at] + (float)(is_hit ? hit : (passed < PASSES ? passed : PASSES) * miss);
        odds[at] = sum < least ? (float)least : sum > most ? (float)most : sum;
        int is = odds[at] >= occupied;
        if (is != was) count = around(&g, at, is - was, beside, counts, touched, count);
    }
    for (int64_t n = 0; n < count; n++) {
        int32_t at = touched[n];
        uint8_t is = UNKNOWN;
        AHEAD(odds, touched, n, count), AHEAD(counts, touched, n, count);
        AHEAD(beside, touched, n, count), AHEAD(state, touched, n, count);
        counts[at] = 0;
        if (odds[at] >= occupied)
            is = OCCUPIED;
        else if (odds[at] <= (beside[at] > 0 ? free_beside : free))
            is = FREE;
        if (is != state[at]) state[at] = is, changed[found++] = at;
    }
    return found;
}

/* Squares of distances in halves of a cell: those from a centre to cubes n cells on along an axis are (2 n - 1)^2. NONE
 * plus the largest of them still fits into a byte, where vectors are wide. */
enum { NONE = 200, MOST_REACH = 4 };

/* One pass of a distance transform along the middle axis of (outer, length, inner) values:
 * out_i = min_j (in_j + (2 |i - j| - 1)^2) for |i - j| <= reach, and in_i itself. */
static void along(
    const uint8_t *restrict in, uint8_t *restrict out, int64_t outer, int64_t length, int64_t inner, int64_t reach) {
    for (int64_t n = 0; n < outer * length * inner; n++) out[n] = in[n];
    for (int64_t o = 0; o < outer; o++)
        for (int64_t i = 0; i < (inner == 1 ? 1 : length); i++)
            for (int64_t j = -reach; j <= reach; j++) {
                /* Values side by side: of one row where inner is 1, else those that share a place in their rows. */
                int64_t first = inner == 1 ? (j < 0 ? -j : 0) : i, last = inner == 1 ? length - (j > 0 ? j : 0) : i + 1;
                if (j == 0 || first + j < 0 || last + j > length || first >= last) continue;
                int64_t twice = 2 * (j < 0 ? -j : j) - 1;
                uint8_t add = (uint8_t)(twice * twice);
                const uint8_t *from = in + (o * length + first + j) * inner;
                uint8_t *to = out + (o * length + first) * inner;
                for (int64_t n = 0; n < (last - first) * inner; n++) {
                    uint8_t sum = (uint8_t)(from[n] + add);
                    to[n] = sum < to[n] ? sum : to[n];
                }
            }
}

/* Distances from the centres of the cells in a window [first, last) to the nearest cell (as a cube) of a kind, at most
 * `reach` cells away, else that length; 0 inside. Kinds are bits: 1 << state. Cells outside of the grid are of the kind
 * where `outside` says so. work holds 2 bytes for each cell of the window grown by `reach`. distance (cells), m. */
int64_t tgco_distances(
    const int64_t *shape, double size, const uint8_t *state, int64_t kinds, int64_t outside, int64_t reach,
    const int64_t *first, const int64_t *last, uint8_t *work, float *distance) {
    int64_t low[3], n[3], r = reach < MOST_REACH ? reach : MOST_REACH;
    for (int i = 0; i < 3; i++) low[i] = first[i] - r, n[i] = last[i] + r - low[i];
    uint8_t *a = work, *b = work + n[0] * n[1] * n[2], of[3];
    for (int is = 0; is < 3; is++) of[is] = (kinds >> is) & 1 ? 0 : NONE;
    for (int64_t x = 0; x < n[0]; x++)
        for (int64_t y = 0; y < n[1]; y++) {
            uint8_t *to = a + (x * n[1] + y) * n[2], beyond = outside ? 0 : NONE;
            int64_t X = low[0] + x, Y = low[1] + y;
            int in = X >= 0 && X < shape[0] && Y >= 0 && Y < shape[1];
            const uint8_t *from = state + (X * shape[1] + Y) * shape[2] + low[2];
            for (int64_t z = 0; z < n[2]; z++)
                to[z] = in && low[2] + z >= 0 && low[2] + z < shape[2] ? of[from[z]] : beyond;
        }
    along(a, b, n[0] * n[1], n[2], 1, r);
    along(b, a, n[0], n[1], n[2], r);
    along(a, b, 1, n[0], n[1] * n[2], r);
    float root[256];
    for (int i = 0; i < 256; i++) root[i] = (float)(size * fmin(0.5 * sqrt(i), (double)r));
    for (int64_t x = r; x < n[0] - r; x++)
        for (int64_t y = r; y < n[1] - r; y++) {
            const uint8_t *from = b + (x * n[1] + y) * n[2] + r;
            float *to = distance + ((low[0] + x) * shape[1] + low[1] + y) * shape[2] + low[2] + r;
            for (int64_t z = 0; z < n[2] - 2 * r; z++) to[z] = root[from[z]];
        }
    return 0;
}

/* The cells from `first` up to before `last` that are at most r away from a cell along each axis. */
static void window(const int64_t *shape, int64_t r, const int64_t *cell, int64_t *first, int64_t *last) {
    for (int i = 0; i < 3; i++) {
        first[i] = cell[i] > r ? cell[i] - r : 0;
        last[i] = cell[i] + r < shape[i] ? cell[i] + r + 1 : shape[i];
    }
}

/* Brings the distances from occupied cells, as `tgco_distances` has them with `outside`, up to date around `changes`
 * cells whose state has changed. gone (changes) is scratch, work as above for the largest window. */
int64_t tgco_distances_around(
    const int64_t *shape, double size, const uint8_t *state, int64_t reach, int64_t changes, const int32_t *changed,
    int32_t *gone, uint8_t *work, float *distance) {
    int64_t r = reach < MOST_REACH ? reach : MOST_REACH, Y = shape[1], Z = shape[2], lost = 0;
    float root[2 * MOST_REACH + 1][2 * MOST_REACH + 1][2 * MOST_REACH + 1];
    for (int64_t x = -r; x <= r; x++)
        for (int64_t y = -r; y <= r; y++)
            for (int64_t z = -r; z <= r; z++) {
                int64_t d[3] = {llabs(x), llabs(y), llabs(z)}, sum = 0;
                for (int i = 0; i < 3; i++) sum += d[i] > 0 ? (2 * d[i] - 1) * (2 * d[i] - 1) : 0;
                root[x + r][y + r][z + r] = (float)(size * fmin(0.5 * sqrt((double)sum), (double)r));
            }
    int64_t low[3] = {shape[0], Y, Z}, high[3] = {0, 0, 0};
    for (int64_t n = 0; n < changes; n++) {
        int32_t at = changed[n];
        int is = state[at] == OCCUPIED, was = distance[at] == 0.0f;
        if (is == was) continue;
        int64_t c[3] = {at / (Y * Z), at / Z % Y, at % Z}, a[3], b[3];
        window(shape, r, c, a, b);
        if (!is) {
            gone[lost++] = at;
            for (int i = 0; i < 3; i++) {
                low[i] = a[i] < low[i] ? a[i] : low[i];
                high[i] = b[i] > high[i] ? b[i] : high[i];
            }
            continue;
        }
        for (int64_t x = a[0]; x < b[0]; x++)
            for (int64_t y = a[1]; y < b[1]; y++) {
                const float *from = &root[x - c[0] + r][y - c[1] + r][a[2] - c[2] + r];
                float *to = distance + (x * Y + y) * Z + a[2];
                for (int64_t z = 0; z < b[2] - a[2]; z++) to[z] = from[z] < to[z] ? from[z] : to[z];
            }
    }
    int64_t kinds = 1 << OCCUPIED, each = 4 * r + 1, whole = 1;
    if (lost == 0) return 0;
    for (int i = 0; i < 3; i++) whole *= high[i] - low[i] + 2 * r;
    if (lost * each * each * each > whole)
        return tgco_distances(shape, size, state, kinds, 1, reach, low, high, work, distance);
    for (int64_t n = 0; n < lost; n++) {
        int64_t c[3] = {gone[n] / (Y * Z), gone[n] / Z % Y, gone[n] % Z}, a[3], b[3];
        window(shape, r, c, a, b);
        tgco_distances(shape, size, state, kinds, 1, reach, a, b, work, distance);
    }
    return 0;
}
