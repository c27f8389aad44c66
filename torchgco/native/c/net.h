/* Layers of a network, for one problem: vectors run over neurons.

   The order of sums depends on the processor alone, not on the number of lanes. Matrices M (k, h) lie row by row, so that
   y = b + M' a, and there are their transposes T (h, k). Arrays over neurons have NET_SIZE(h) numbers, of which those
   from h on are of no account; tangents G are such arrays for each column. */
#pragma once
#include "functions.h"
#include "wide.h" /* or scalar/wide.h */

#define NET_SIZE(h) (((h) + 15) / 16 * 16) /* whole vectors of neurons or lanes, in single precision, too */

static inline V net_lanes(const REAL *from) { V r; memcpy(&r, from, sizeof r); return r; }
static inline void net_store(REAL *to, V a) { memcpy(to, &a, sizeof a); }

/* Weights as numbers of a layer's neurons. */
static inline void net_weights(const double *from, int h, REAL *to) {
    memset(to + h, 0, (NET_SIZE(h) - h) * sizeof(REAL));
    for (int i = 0; i < h; i++) to[i] = (REAL)from[i];
}

static inline int net_first(I left) { int l = 0; while (!LANE(left, l)) l++; return l; }

/* R vectors of y. */
#define NET_AFFINE(R) \
    TGCO_INLINE void net_affine_##R( \
        const double *M, const double *b, int k, int h, const REAL *a, REAL *y) { \
        Wide s[R]; \
        NET_EACH(r, R) s[r] = b ? net_load(b + r * NET_WIDTH) : NET_ZERO; \
        for (int j = 0; j < k; j++) { \
            Wide z = net_set(a[j]); \
            NET_EACH(r, R) s[r] = net_fused(z, net_load(M + (int64_t)j * h + r * NET_WIDTH), s[r]); \
        } \
        memcpy(y, s, sizeof s); \
    }
NET_AFFINE(8)
NET_AFFINE(4)
NET_AFFINE(2)
NET_AFFINE(1)

/* The sum of w a over n neurons. */
static inline REAL net_dot(const double *w, const REAL *a, int n) {
    Wide s = NET_ZERO;
    int i = 0;
    for (; i + NET_WIDTH <= n; i += NET_WIDTH) s = net_fused(net_load(w + i), net_wide(a + i), s);
    REAL total = 0;
    for (int l = 0; l < NET_WIDTH; l++) total += NET_ENTRY(s, l);
    for (; i < n; i++) total = net_fused_1((REAL)w[i], a[i], total);
    return total;
}

/* y (h) = b + M' a for a (k); b may be none. What fills y up to whole vectors is 0. */
TGCO_APART void net_affine(
    const double *M, const double *T, const double *b, int k, int h, const REAL *a, REAL *y) {
    int i = 0;
    memset(y + h, 0, (NET_SIZE(h) - h) * sizeof(REAL));
    if (h <= 8) { /* few long sums */
        for (; i < h; i++) y[i] = (b ? (REAL)b[i] : 0) + net_dot(T + (int64_t)i * k, a, k);
        return;
    }
    for (; i + 8 * NET_WIDTH <= h; i += 8 * NET_WIDTH) net_affine_8(M + i, b ? b + i : 0, k, h, a, y + i);
    for (; i + 4 * NET_WIDTH <= h; i += 4 * NET_WIDTH) net_affine_4(M + i, b ? b + i : 0, k, h, a, y + i);
    for (; i + 2 * NET_WIDTH <= h; i += 2 * NET_WIDTH) net_affine_2(M + i, b ? b + i : 0, k, h, a, y + i);
    for (; i < h; i += NET_WIDTH) {
        if (i > h - NET_WIDTH) i = h - NET_WIDTH; /* the last vector computes again some that are there already */
        net_affine_1(M + i, b ? b + i : 0, k, h, a, y + i);
    }
}

/* R vectors of M' G for C columns. */
#define NET_COLUMNS(R, C) \
    TGCO_INLINE void net_columns_##R##_##C( \
        const double *M, int k, int h, const REAL *G, REAL *sums) { \
        Wide s[R][C]; \
        NET_EACH(r, R) NET_EACH(c, C) s[r][c] = NET_ZERO; \
        for (int j = 0; j < k; j++) { \
            Wide m[R]; \
            NET_EACH(r, R) m[r] = net_load(M + (int64_t)j * h + r * NET_WIDTH); \
            NET_EACH(c, C) { \
                Wide g = net_set(G[c * NET_SIZE(k) + j]); \
                NET_EACH(r, R) s[r][c] = net_fused(m[r], g, s[r][c]); \
            } \
        } \
        NET_EACH(r, R) NET_EACH(c, C) \
            memcpy(sums + c * NET_SIZE(h) + r * NET_WIDTH, &s[r][c], sizeof s[r][c]); \
    } \

#define NET_COLUMN_BLOCKS(C) \
    NET_COLUMNS(2, C) \
    NET_COLUMNS(1, C) \
    static void net_columns_##C(const double *M, int k, int h, const REAL *G, REAL *sums) { \
        int i = 0; \
        for (; i + 2 * NET_WIDTH <= h; i += 2 * NET_WIDTH) net_columns_2_##C(M + i, k, h, G, sums + i); \
        for (; i < h; i += NET_WIDTH) { \
            if (i > h - NET_WIDTH) i = h - NET_WIDTH; /* the last vector computes again some that are there already */ \
            net_columns_1_##C(M + i, k, h, G, sums + i); \
        } \
    }
NET_COLUMN_BLOCKS(6)
NET_COLUMN_BLOCKS(4)
NET_COLUMN_BLOCKS(2)
NET_COLUMN_BLOCKS(1)

/* sums (d, h) = M' G for tangents G (d, k). */
TGCO_APART void net_columns(
    const double *M, const double *T, int k, int h, int d, const REAL *G, REAL *sums) {
    if (h <= 8) {
        for (int i = 0; i < h; i++)
            for (int c = 0; c < d; c++) sums[c * NET_SIZE(h) + i] = net_dot(T + (int64_t)i * k, G + c * NET_SIZE(k), k);
        return;
    }
    for (int c = 0, step; c < d; c += step, G += step * NET_SIZE(k), sums += step * NET_SIZE(h)) {
        step = d - c >= 6 ? 6 : d - c >= 4 ? 4 : d - c >= 2 ? 2 : 1;
        if (step == 6) net_columns_6(M, k, h, G, sums);
        else if (step == 4) net_columns_4(M, k, h, G, sums);
        else if (step == 2) net_columns_2(M, k, h, G, sums);
        else net_columns_1(M, k, h, G, sums);
    }
}

/* v (k) += s = M y for y (h). */
static inline void net_back(const double *M, const double *T, int k, int h, const REAL *y, REAL *v, REAL *s) {
    net_affine(T, M, 0, h, k, y, s);
    for (int j = 0; j < k; j++) v[j] += s[j];
}

/* What y adds with a slope: nothing where y is 0, as in a branch that isn't taken, be the slope infinite or NaN. */
static inline REAL net_counted(REAL y, REAL slope) { return y != 0 ? slope * y : 0; }

/* sum_i w_i s_i t_i over the neurons whose w isn't 0. */
TGCO_APART REAL net_sum_of_counted(int h, const REAL *w, const REAL *s, const REAL *t) {
    REAL total = 0;
    for (int i = 0; i < h; i++) total += net_counted(w[i], s[i] * t[i]);
    return total;
}

/* H[a][b] += sum_i w_i s_i t_i for two tangents s, the columns a and a + 1, and up to C tangents t, b and after. */
#define NET_PAIRS(C) \
    static void net_pairs_##C(int h, int d, const REAL *w, const REAL *s, const REAL *t, REAL *H) { \
        Wide sum[2][C]; \
        NET_EACH(a, 2) NET_EACH(b, C) sum[a][b] = NET_ZERO; \
        int i = 0, size = NET_SIZE(h); \
        for (; i + NET_WIDTH <= h; i += NET_WIDTH) { \
            Wide by = net_wide(w + i), first = net_times(by, net_wide(s + i)), second = net_times(by, net_wide(s + size + i)); \
            NET_EACH(b, C) { \
                Wide other = net_wide(t + b * size + i); \
                sum[0][b] = net_fused(first, other, sum[0][b]); \
                sum[1][b] = net_fused(second, other, sum[1][b]); \
            } \
        } \
        for (int a = 0; a < 2; a++) NET_EACH(b, C) { \
            REAL total = 0; \
            for (int l = 0; l < NET_WIDTH; l++) total += NET_ENTRY(sum[a][b], l); \
            for (int j = i; j < h; j++) total = net_fused_1(w[j] * s[a * size + j], t[b * size + j], total); \
            H[a * d + b] += total == total ? total : net_sum_of_counted(h, w, s + a * size, t + b * size); \
        } \
    }
NET_PAIRS(6)
NET_PAIRS(2)

/* H (d, d) += sum_i w_i s_i t_i', its upper triangle at least, for tangents s and t (d, h); H, s and t have a column
   more than d where d is odd. */
TGCO_APART void net_congruence(int h, int d, const REAL *w, const REAL *s, const REAL *t, REAL *H) {
    int even = d + d % 2, size = NET_SIZE(h);
    for (int a = 0; a < even; a += 2)
        for (int b = a, step; b < even; b += step) {
            step = even - b >= 6 ? 6 : 2;
            (step == 6 ? net_pairs_6 : net_pairs_2)(h, even, w, s + a * size, t + b * size, H + a * even + b);
        }
}
