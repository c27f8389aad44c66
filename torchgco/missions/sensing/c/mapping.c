/* The vehicle's map: log-odds of cells updated along rays, and distances from cells to the nearest of a kind. */

#include <math.h>
#include <stddef.h>
#include <stdint.h>

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

/* What a cell's stamp holds: the number of the scan that touched it last, how many rays ended in it, and how many passed,
 * at most MOST_RAYS each. */
enum { MOST_RAYS = 4095, PASS = 1, RETURN = 4096, SCAN = 4096 * 4096 };
/* Passes of a scan that count; and passes per return up to which the cell is occupied. Fewer returns are noise of a
 * surface beside it. */
enum { PASSES = 7, PER_RETURN = 8 };

static inline int64_t returns(int64_t stamp) { return stamp / RETURN % RETURN; }
static inline int64_t passes(int64_t stamp) { return stamp % RETURN; }

/* Counts the rays that pass cells: here one, from its origin inside the grid over a length. Of a cell that it only cuts
 * the corner of, for less than `chord`, it shows nothing; nor of the cell `last`, in which it ends. */
static int64_t pass(
    const Grid *g, const double *o, const double *d, double length, double chord, int64_t last, int64_t *stamp, int64_t now,
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
    while (t < length) {
        int i = wait[0] < wait[1] ? (wait[0] < wait[2] ? 0 : 2) : (wait[1] < wait[2] ? 1 : 2);
        double next = wait[i], end = next < length ? next : length;
        if (end - t >= chord && at != last) {
            if (stamp[at] < now) stamp[at] = now, touched[count++] = (int32_t)at;
            if (passes(stamp[at]) < MOST_RAYS) stamp[at] += PASS;
        }
        if (left[i]-- == 0) break;
        t = next, wait[i] += per[i], at += stride[i];
    }
    return count;
}

/* Whether one of the 26 cells around a cell is occupied. With a list: adds those to it that the scan `now` hasn't touched,
 * and returns its length. */
static int64_t beside(
    const Grid *g, const float *odds, double occupied, int64_t at, int64_t *stamp, int64_t now, int32_t *touched,
    int64_t count) {
    int64_t Y = g->shape[1], Z = g->shape[2], c[3] = {at / (Y * Z), at / Z % Y, at % Z};
    for (int64_t x = c[0] - 1; x <= c[0] + 1; x++)
        for (int64_t y = c[1] - 1; y <= c[1] + 1; y++)
            for (int64_t z = c[2] - 1; z <= c[2] + 1; z++) {
                if (x < 0 || y < 0 || z < 0 || x >= g->shape[0] || y >= Y || z >= Z) continue;
                int64_t other = (x * Y + y) * Z + z;
                if (touched == NULL && other != at && odds[other] >= occupied) return 1;
                if (touched != NULL && stamp[other] < now) stamp[other] = now, touched[count++] = (int32_t)other;
            }
    return count;
}

/* Adds a scan to the map. Cells with returns get `hit`, others `miss` for each ray that passed, up to PASSES of them.
 * A cell is occupied from the odds `occupied` on, free up to `free`, beside an occupied one up to `free_beside`.
 *
 * odds (cells), state (cells), stamp (cells): see SCAN.
 * touched (cells) is scratch; changed (cells) gets the cells whose state changed. Returns how many. */
int64_t tgco_add_scan(
    const int64_t *shape, const double *corner, double size, float *odds, uint8_t *state, int64_t *stamp, int64_t scan,
    int64_t rays, const double *origin, const double *directions, const double *distances, double range, double before,
    double chord, double hit, double miss, double least, double most, double free, double free_beside, double occupied,
    int32_t *touched,
    int32_t *changed) {
    Grid g = {shape, corner, size};
    int64_t count = 0, found = 0;
    int64_t now = SCAN * scan;
    for (int64_t k = 0; k < rays; k++) {
        if (!isfinite(distances[k])) continue;
        double p[3];
        int64_t c[3];
        for (int i = 0; i < 3; i++) p[i] = origin[i] + distances[k] * directions[3 * k + i];
        if (!cell_of(&g, p, c)) continue;
        int64_t at = place(&g, c);
        if (stamp[at] < now) stamp[at] = now, touched[count++] = (int32_t)at;
        if (returns(stamp[at]) < MOST_RAYS) stamp[at] += RETURN;
    }
    for (int64_t k = 0; k < rays; k++) {
        double length = range, p[3];
        int64_t last = -1, c[3];
        if (isfinite(distances[k])) {
            length = distances[k] - before;
            for (int i = 0; i < 3; i++) p[i] = origin[i] + distances[k] * directions[3 * k + i];
            if (cell_of(&g, p, c)) last = place(&g, c);
        }
        count = pass(&g, origin, directions + 3 * k, length, chord, last, stamp, now, touched, count);
    }
    for (int64_t n = 0; n < count; n++) {
        int32_t at = touched[n];
        int64_t ended = returns(stamp[at]), passed = passes(stamp[at]);
        int is_hit = ended > 0 && passed <= PER_RETURN * ended;
        float sum = odds[at] + (float)(is_hit ? hit : (passed < PASSES ? passed : PASSES) * miss);
        odds[at] = sum < least ? (float)least : sum > most ? (float)most : sum;
    }
    for (int64_t n = 0; n < count; n++) {
        int32_t at = touched[n];
        uint8_t is = UNKNOWN;
        if (odds[at] >= occupied)
            is = OCCUPIED;
        else if (odds[at] <= free)
            is = odds[at] <= free_beside || !beside(&g, odds, occupied, at, stamp, 0, NULL, 0) ? FREE : UNKNOWN;
        if (is == state[at]) continue;
        state[at] = is, changed[found++] = at;
        if (is == OCCUPIED) count = beside(&g, odds, occupied, at, stamp, now, touched, count);
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
