/* Squared distances of points and of segments from boxes; box.h has the numbers of a box. */

#include <float.h>
#include <math.h>

/* Squared distance of a point, and half its slope where the point moves along a segment. */
static inline double square_at(
    const double *half, const double *begin, const double *along, double share, double *slope) {
    double square = 0.0, sum = 0.0;
    for (int i = 0; i < DIM; i++) {
        double away = beyond(begin[i] + share * along[i], half[i]);
        square += away * away;
        sum += away * along[i];
    }
    *slope = sum;
    return square;
}

static double square_from_box(const double *box, const double *p) {
    double local[DIM], none[DIM] = {0.0}, slope;
    seen_from(box, p, local);
    return square_at(BOX_HALF(box), local, none, 0.0, &slope);
}

/* Smallest squared distance of the segment from `start` to `start + step`. */
static inline double square_of_segment(const double *box, const double *start, const double *step) {
    double begin[DIM], along[DIM], low = 0.0, high = 1.0, falls, rises, found;
    const double *half = BOX_HALF(box);
    seen_from(box, start, begin);
    along_sides(box, step, along);
    square_at(half, begin, along, low, &falls);
    square_at(half, begin, along, high, &rises);
    for (int i = 0; i < DIM; i++)
        for (int side = -1; side <= 1; side += 2) {
            double share = (side * half[i] - begin[i]) / (along[i] == 0.0 ? 1.0 : along[i]);
            share = share < 0.0 ? 0.0 : share > 1.0 ? 1.0 : share;
            square_at(half, begin, along, share, &found);
            int left = found < 0.0 && share > low, right = found >= 0.0 && share < high;
            low = left ? share : low, falls = left ? found : falls;
            high = right ? share : high, rises = right ? found : rises;
        }
    double change = rises - falls, part = -falls / (change > DBL_MIN ? change : DBL_MIN);
    part = part < 0.0 ? 0.0 : part > 1.0 ? 1.0 : part;
    return square_at(half, begin, along, falls < 0.0 ? low + (high - low) * part : low, &found);
}

/* The extent of some segments from a to a + along. */
static inline void extent(int count, double a[DIM][count], double along[DIM][count], double *least, double *most) {
    for (int i = 0; i < DIM; i++) {
        least[i] = INFINITY, most[i] = -INFINITY;
        for (int e = 0; e < count; e++) {
            double start = a[i][e], end = start + along[i][e], low = start < end ? start : end;
            double high = start < end ? end : start;
            least[i] = low < least[i] ? low : least[i];
            most[i] = high > most[i] ? high : most[i];
        }
    }
}

/* Lowers `gap`, the distances of segments from a to a + along from the surface, and `open`, a measure with the same
   sign. Distances above `margin` don't count: the segments whose extent, or that of all together (`least`, `most`),
   shows that they are so far are left out, as well as those that another box blocks. */
static inline void measure_box(
    const double *box, int count, double a[DIM][count], double along[DIM][count], const double *least,
    const double *most, double margin, double *gap, double *open
) {
    const double *axes = box + DIM, *half = BOX_HALF(box), radius = BOX_RADIUS(box);
    if (radius < 0) return;
    double low[DIM], high[DIM];
    for (int i = 0; i < DIM; i++) {
        double reach = radius + margin;
        for (int j = 0; j < DIM; j++) reach += fabs(axes[j * DIM + i]) * half[j];
        reach += 1e-9 * (fabs(reach) + fabs(box[i])); /* more than rounding */
        low[i] = box[i] - reach, high[i] = box[i] + reach;
        if (least[i] > high[i] || most[i] < low[i]) return;
    }
    for (int e = 0; e < count; e++) {
        double start[DIM], step[DIM];
        int near = open[e] > 0.0;
        for (int i = 0; i < DIM; i++) {
            double end = a[i][e] + along[i][e];
            start[i] = a[i][e], step[i] = along[i][e];
            near &= (start[i] <= high[i] || end <= high[i]) && (start[i] >= low[i] || end >= low[i]);
        }
        if (!near) continue;
        double away = square_of_segment(box, start, step), left = sqrt(away) - radius, more = away - radius * radius;
        gap[e] = left < gap[e] ? left : gap[e];
        open[e] = more < open[e] ? more : open[e];
    }
}
