/* Paths ------------------------------------------------------------------------------------------------------------ */

static size_t room_size(int64_t n, int64_t k) {
    return (2 * n * k + 2 * n + k) * sizeof(double) + (n * k + 4 * n + 2) * sizeof(int32_t);
}

static Room room_at(void *memory, int64_t n, int64_t k) {
    Room r = {.edge = memory};
    r.value = r.edge + n * k;
    r.cost = r.value + n * k;
    r.before = r.cost + n;
    r.through = r.before + n;
    r.source = (int32_t *)(r.through + k);
    r.first = r.source + n * k;
    r.fresh = r.first + n + 2;
    r.next = r.fresh + n;
    r.seen = r.next + n;
    return r;
}

/* Sort edges by the point where they end: once that point's cost has fallen, they pass the change on. */
static void turn(Room *r, int64_t n, int64_t k, const int32_t *ends) {
    int32_t *first = r->first;
    memset(first, 0, (n + 2) * sizeof(int32_t));
    for (int64_t v = 0; v < n; v++)
        for (int64_t e = v * k; e < (v + 1) * k && ends[e] >= 0; e++) first[ends[e] + 2]++;
    for (int64_t v = 0; v < n; v++) first[v + 2] += first[v + 1];
    for (int64_t v = 0; v < n; v++)
        for (int64_t e = v * k; e < (v + 1) * k && ends[e] >= 0; e++) {
            int32_t place = first[ends[e] + 1]++;
            r->source[place] = (int32_t)v;
            r->value[place] = r->edge[e];
        }
}

/* Costs of the cheapest paths to point 1 with at most `rounds` edges: a round reads the costs of the round before. */
static void relax(Room *r, int64_t n, int64_t rounds) {
    int64_t fresh = 1;
    for (int64_t v = 0; v < n; v++) r->cost[v] = INFINITY, r->seen[v] = -1;
    r->cost[1] = 0.0;
    r->fresh[0] = 1;
    for (int32_t round = 0; round < rounds && fresh > 0; round++) {
        int64_t next = 0;
        for (int64_t f = 0; f < fresh; f++) r->before[f] = r->cost[r->fresh[f]];
        for (int64_t f = 0; f < fresh; f++)
            for (int32_t e = r->first[r->fresh[f]]; e < r->first[r->fresh[f] + 1]; e++) {
                int32_t v = r->source[e];
                double through = r->value[e] + r->before[f];
                if (!(through < r->cost[v])) continue;
                r->cost[v] = through;
                if (r->seen[v] != round) r->seen[v] = round, r->next[next++] = v;
            }
        int32_t *done = r->fresh;
        r->fresh = r->next, r->next = done, fresh = next;
    }
}

/* The cheapest path from point 0 to point 1, as corners; returns whether there is one. */
static int cheapest(
    const Search *s, Room r, const double *p, int64_t n, int64_t k, const int32_t *ends, const double *lengths,
    const double *price, double *path
) {
    for (int64_t v = 0; v < n; v++)
        for (int64_t e = v * k; e < (v + 1) * k && ends[e] >= 0; e++)
            r.edge[e] = lengths[e] * 0.5 * (price[v] + price[ends[e]]);
    turn(&r, n, k, ends);
    relax(&r, n, s->corners - 1);
    int64_t stop = 0;
    for (int64_t c = 0; c < s->corners; c++) {
        memcpy(path + c * DIM, p + stop * DIM, DIM * sizeof(double));
        if (stop == 1 || c + 1 == s->corners) continue;
        double best = INFINITY;
        int64_t first = stop * k, e = first;
        for (; e < first + k && ends[e] >= 0; e++) {
            r.through[e - first] = r.edge[e] + r.cost[ends[e]];
            if (r.through[e - first] < best) best = r.through[e - first];
        }
        if (!(best < INFINITY)) return 0;
        for (e = first; !(r.through[e - first] <= best + s->tie * fabs(best)); e++) continue;
        stop = ends[e];
    }
    return stop == 1;
}

/* Number of edges of a path: its corners that differ from its end. */
static int64_t edges_of(const double *path, int64_t corners) {
    int64_t edges = 0;
    for (int64_t c = 0; c < corners; c++) {
        int other = 0;
        for (int i = 0; i < DIM; i++) other |= path[c * DIM + i] != path[(corners - 1) * DIM + i];
        edges += other;
    }
    return edges;
}

/* Start and goal of a path, then alternately the middles of its edges and its other corners. */
static void lay(const double *path, int64_t corners, double *string) {
    memcpy(string, path, DIM * sizeof(double));
    memcpy(string + DIM, path + (corners - 1) * DIM, DIM * sizeof(double));
    for (const double *a = path, *end = path + (corners - 1) * DIM; a < end; a += DIM, string += 2 * DIM)
        for (int i = 0; i < DIM; i++) {
            string[2 * DIM + i] = 0.5 * (a[i] + a[DIM + i]);
            if (a + DIM < end) string[3 * DIM + i] = a[DIM + i];
        }
}

/* Called from Python; 0 where there is no memory ------------------------------------------------------------------- */

int32_t tgco_graph(const Search *s) {
    int64_t n = s->points, k = s->edges, list = n + k + s->midway;
    int64_t size = (DIM + 2) * s->spheres + (DIM + 1) * n + DIM * s->candidates + list;
    double *memory = malloc(size * sizeof(double) + list * sizeof(int32_t) + n);
    if (!memory) return 0;
    double *at = memory + (DIM + 2) * s->spheres, *others = at + (DIM + 1) * n, *values = others + DIM * s->candidates;
    int32_t *indices = (int32_t *)(memory + size);
    uint8_t *usable = (uint8_t *)(indices + list);
    for (int64_t b = 0; b < s->problems; b++) {
        Spheres o = spheres_of(s, b, memory);
        int64_t count = propose(s, b, values, indices, others);
        choose(s, b, &o, others, count, values, indices, usable);
        join(s, b, usable, at, values, indices);
        int32_t *ends = s->ends + b * n * k;
        measure(s, &o, s->nodes + b * n * DIM, n, k, ends, s->lengths + b * n * k);
        pack(n, k, ends, s->lengths + b * n * k);
    }
    free(memory);
    return 1;
}

int32_t tgco_cheapest(const Search *s) {
    int64_t n = s->points, k = s->edges, size = s->corners * DIM;
    void *memory = malloc(room_size(n, k));
    if (!memory) return 0;
    Room room = room_at(memory, n, k);
    for (int64_t b = 0; b < s->problems; b++) {
        const double *p = s->nodes + b * n * DIM;
        double *path = s->path + b * size;
        s->arrives[b] = cheapest(
            s, room, p, n, k, s->ends + b * n * k, s->lengths + b * n * k, s->price + b * n, path
        );
        if (!s->arrives[b])
            for (int64_t c = 0; c < s->corners; c++) memcpy(path + c * DIM, p + (c > 0) * DIM, DIM * sizeof(double));
        lay(path, s->corners, s->string + b * (2 * s->corners - 1) * DIM);
    }
    free(memory);
    return 1;
}

int32_t tgco_taut(const Search *s) {
    int64_t most = 2 * s->corners - 1, size = s->corners * DIM;
    size_t lengths_size = most * most * sizeof(double), ends_size = most * most * sizeof(int32_t);
    size_t room = room_size(most, most), spheres = (DIM + 2) * s->spheres * sizeof(double);
    char *memory = malloc(lengths_size + size * sizeof(double) + spheres + room + ends_size);
    if (!memory) return 0;
    double *lengths = (double *)memory, *taut = lengths + most * most, *at = taut + size;
    void *rest = at + (DIM + 2) * s->spheres;
    int32_t *ends = (int32_t *)((char *)rest + room);
    for (int64_t b = 0; b < s->problems; b++) {
        double *path = s->path + b * size;
        int64_t n = 2 * edges_of(path, s->corners) + 1;
        if (n == 1) continue;
        Spheres o = spheres_of(s, b, at);
        for (int64_t e = 0; e < n * n; e++) ends[e] = (int32_t)(e % n);
        const double *p = s->string + b * most * DIM;
        measure(s, &o, p, n, n, ends, lengths);
        pack(n, n, ends, lengths);
        if (cheapest(s, room_at(rest, n, n), p, n, n, ends, lengths, s->cost + b * most, taut))
            memcpy(path, taut, size * sizeof(double));
    }
    free(memory);
    return 1;
}

int32_t tgco_raise(const Search *s) {
    int64_t n = s->points, M = s->spheres;
    double *at = malloc((DIM + 1) * n * sizeof(double)), *nearest = at + DIM * n;
    if (!at) return 0;
    for (int64_t b = 0; b < s->problems; b++) {
        const double *path = s->path + b * s->corners * DIM, *R = s->distances + b * M;
        double reach = 0.0;
        for (int64_t m = 0; m < M; m++) reach = R[m] > reach ? R[m] : reach;
#if BOXES
        if (s->largest[b] > reach) reach = s->largest[b];
#endif
        for (int64_t v = 0; v < n; v++) {
            nearest[v] = INFINITY;
            for (int i = 0; i < DIM; i++) at[i * n + v] = s->nodes[(b * n + v) * DIM + i];
        }
        for (const double *a = path; a < path + (s->corners - 1) * DIM; a += DIM) {
            double along[DIM], square = 0.0;
            for (int i = 0; i < DIM; i++) along[i] = a[DIM + i] - a[i], square += along[i] * along[i];
            double inverse = 1.0 / (square < TINY ? TINY : square);
            for (int64_t v = 0; v < n; v++) {
                double point[DIM];
                for (int i = 0; i < DIM; i++) point[i] = at[i * n + v];
                double away = square_away(point, a, along, inverse);
                nearest[v] = away < nearest[v] ? away : nearest[v];
            }
        }
        for (int64_t v = 0; v < n; v++)
            if (nearest[v] < reach * reach) s->price[b * n + v] *= s->factor;
    }
    free(at);
    return 1;
}
