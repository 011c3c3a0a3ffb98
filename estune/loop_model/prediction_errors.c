/* Prediction errors of records for given poles, noise and dead time.

The same as `least_squares.Solution`, which says why: the numerator, start states and offsets of
least squares. With white noise the filters follow from the poles, else they are given. Rows of signals are behind one another: group by group, record by record, without
the samples of the history. */

#define MOST_COLUMNS 24 /* twice the most start states and offsets, for a turned copy */
#define NUISANCE_APART 1e-7
#define COLLINEAR 1e-10
#define COORDINATE_STEP 1e-6

typedef struct {
    long order, terms, dead, groups, residuals, longest, given;
    long zeros, over, colours;    /* sections of C and of A, taps of P N; none with white noise */
    double hum;                   /* rad/sample; zero without one */
    const double *coordinates;    /* (order,) */
    const double *filters;        /* (zeros + over, 3) and (colours,) */
    const long *sizes;            /* (groups, 3): records, samples, history */
    const long *signals;          /* (groups, 2): addresses of effort and measurement */
    double *numerator;            /* (terms,); input where it is given */
    long *ranks;                  /* (groups,): columns of the nuisance of each */
    double *nuisance;             /* (groups, MOST_COLUMNS, longest) */
    double *regressors, *basis;   /* (terms, residuals) */
    double *residual, *slopes;    /* (residuals,), (order, residuals) */
} FitTask;

typedef double Two __attribute__((vector_size(16), aligned(8)));

static double dot(long n, const double *x, const double *y)
{
    Two a = {0.0, 0.0}, b = a, c = a, d = a;
    double rest = 0.0;
    long i;
    for (i = 0; i + 7 < n; i += 8) {
        const Two *p = (const Two *)(x + i), *q = (const Two *)(y + i);
        a += p[0] * q[0], b += p[1] * q[1], c += p[2] * q[2], d += p[3] * q[3];
    }
    for (; i < n; i++)
        rest += x[i] * y[i];
    a += b, c += d, a += c;
    return a[0] + a[1] + rest;
}

static void less(long n, double share, const double *x, double *y)
{
    long i;
    for (i = 0; i < n; i++)
        y[i] -= share * x[i];
}

static void scale(long n, double by, const double *x, double *y)
{
    long i;
    for (i = 0; i < n; i++)
        y[i] = by * x[i];
}

/* Signals less their part in orthonormal rows. */
static void without(long n, long rows, long stride, const double *Q, double *x)
{
    double shares[MOST_COLUMNS];
    long j;
    for (j = 0; j < rows; j++)
        shares[j] = dot(n, Q + j * stride, x);
    for (j = 0; j < rows; j++)
        less(n, shares[j], Q + j * stride, x);
}

/* Orthonormal rows in place of rows, from one on before which they are already; triangle has their
 * shares. What loses half of its size is orthogonalised twice, which is enough. */
static void orthonormal(long n, long from, long rows, long stride, double *Q, double *triangle)
{
    long i, j, again;
    for (j = from; j < rows; j++) {
        for (i = 0; i < rows; i++)
            triangle[i * rows + j] = 0.0;
        double *x = Q + j * stride, size = sqrt(dot(n, x, x)), before = HUGE_VAL;
        for (again = 0; again < 2 && j && !(size > 0.5 * before); again++) {
            for (i = 0; i < j; i++) {
                double share = dot(n, Q + i * stride, x);
                less(n, share, Q + i * stride, x);
                triangle[i * rows + j] += share;
            }
            before = size, size = sqrt(dot(n, x, x));
        }
        triangle[j * rows + j] = size;
        scale(n, size > 0.0 ? 1.0 / size : 0.0, x, x);
    }
}

/* W = U S of W = U S V', by rotations of its columns (Hestenes); V may be NULL. */
static void rotate(long m, double *W, double *V)
{
    long i, p, q, sweep, turned = 1;
    for (i = 0; V && i < m * m; i++)
        V[i] = i % (m + 1) == 0;
    for (sweep = 0; turned && sweep < 60; sweep++)
        for (turned = p = 0; p < m; p++)
            for (q = p + 1; q < m; q++) {
                double a = 0.0, b = 0.0, c = 0.0, zeta, t, cosine;
                for (i = 0; i < m; i++) {
                    double x = W[i * m + p], y = W[i * m + q];
                    a += x * x, b += y * y, c += x * y;
                }
                if (!(fabs(c) > 1e-15 * sqrt(a * b)))
                    continue;
                turned = 1, zeta = (b - a) / (2.0 * c);
                t = (zeta < 0.0 ? -1.0 : 1.0) / (fabs(zeta) + sqrt(1.0 + zeta * zeta));
                cosine = 1.0 / sqrt(1.0 + t * t);
                for (i = 0; i < 2 * m; i++) {
                    double *row = i < m ? W + i * m : V ? V + (i - m) * m : NULL;
                    if (row) {
                        double x = row[p], y = row[q];
                        row[p] = cosine * (x - t * y), row[q] = cosine * (y + t * x);
                    }
                }
            }
}

static double column_size(long m, const double *W, long j)
{
    double sum = 0.0;
    long i;
    for (i = 0; i < m; i++)
        sum += W[i * m + j] * W[i * m + j];
    return sqrt(sum);
}

/* Least squares of a triangle, of least size along what is collinear. */
static void solve(long m, double *triangle, const double *y, double *found)
{
    double V[MOST_COLUMNS * MOST_COLUMNS], largest = 0.0;
    long i, j;
    rotate(m, triangle, V);
    for (j = 0; j < m; j++)
        largest = fmax(largest, column_size(m, triangle, j)), found[j] = 0.0;
    for (j = 0; j < m; j++) {
        double size = column_size(m, triangle, j), share = 0.0;
        if (!(size > COLLINEAR * largest))
            continue;
        for (i = 0; i < m; i++)
            share += triangle[i * m + j] * y[i];
        for (i = 0; i < m; i++)
            found[i] += V[i * m + j] * share / (size * size);
    }
}

typedef struct {
    long size;
    double taps[3], mirrored[3];
    int grows;
} Section;

static long sections_at(long order, const double *x, Section *s)
{
    long i, k, count = (order + 1) / 2;
    for (i = 0; i < count; i++) {
        Section *own = s + i;
        double re[2], im[2] = {0.0, 0.0}, *kinds[2];
        kinds[0] = own->taps, kinds[1] = own->mirrored;
        own->size = 2 * i + 1 < order ? 3 : 2;
        if (own->size == 3)
            pair(x[2 * i], x[2 * i + 1], re, im);
        else
            re[0] = single(x[2 * i]);
        own->grows = re[0] > 0.0 || (own->size == 3 && re[1] > 0.0);
        for (k = 0; k < 2; k++) {
            double *c = kinds[k];
            double p = exp(k ? -fabs(re[0]) : re[0]);
            c[0] = 1.0, c[1] = -p, c[2] = 0.0;
            if (own->size == 3) {
                double q = exp(k ? -fabs(re[1]) : re[1]);
                c[1] = -(p * cos(im[0]) + q * cos(im[1]));
                c[2] = p * q * cos(im[0] + im[1]);
            }
        }
    }
    return count;
}

/* A signal through a filter of three terms above and below; in place where out is x. */
static void filter(long n, const double *above, const double *below, const double *x, double *out)
{
    double x1 = 0.0, x2 = 0.0, y1 = 0.0, y2 = 0.0;
    long i;
    for (i = 0; i < n; i++) {
        double now = x[i];
        double y = above[0] * now + above[1] * x1 + above[2] * x2 - below[2] * y2 - below[1] * y1;
        x2 = x1, x1 = now, y2 = y1, y1 = y, out[i] = y;
    }
}

static const double ONE[3] = {1.0, 0.0, 0.0};

/* A signal through A over A mirrored, of the poles outside the unit circle but one section. */
static void all_pass(long n, long count, const Section *s, long but, double *x)
{
    long i;
    for (i = 0; i < count; i++)
        if (s[i].grows && i != but)
            filter(n, s[i].taps, s[i].mirrored, x, x);
}

/* A signal through P N, in place. */
static void colour(const FitTask *t, long n, double *x)
{
    const double *taps = t->filters + 3 * (t->zeros + t->over);
    for (; n > 0; n--) {
        double sum = 0.0;
        long k;
        for (k = 0; k < t->colours && k < n; k++)
            sum += taps[k] * x[n - 1 - k];
        x[n - 1] = sum;
    }
}

/* A signal through 1/H, in place. */
static void whiten(const FitTask *t, long n, long count, const Section *s, double *x)
{
    long i;
    if (!t->zeros) {
        all_pass(n, count, s, -1, x);
        return;
    }
    for (i = 0; i < t->zeros; i++)
        filter(n, i < t->over ? t->filters + 3 * (t->zeros + i) : ONE, t->filters + 3 * i, x, x);
    colour(t, n, x);
}

/* The effort through its filter but for B, in place. */
static void drive(const FitTask *t, long n, long count, const Section *s, double *x)
{
    long i;
    if (t->zeros)
        colour(t, n, x);
    for (i = 0; i < (t->zeros ? t->zeros : count); i++)
        filter(n, ONE, t->zeros ? t->filters + 3 * i : s[i].mirrored, x, x);
}

/* Poles whose start states are free, with such a history. */
static long swinging(const FitTask *t, long history)
{
    return t->zeros || history || t->order < 2 ? t->order : 2;
}

/* Orthonormal rows of start states and offsets in n samples; their number. */
static long nuisance_at(const FitTask *t, long history, long n, double *Q)
{
    Section s[MOST_SECTIONS];
    long i, j, k, rows = 0, rank = 0, count = sections_at(swinging(t, history), t->coordinates, s);
    long stride = t->longest, levels = t->hum ? 5 : 1, free_ones = t->zeros ? t->zeros : count;
    double W[MOST_COLUMNS * MOST_COLUMNS], sizes[MOST_COLUMNS], largest = 0.0, *last = Q;
    for (i = 0; i < free_ones; i++) {
        double *free = Q + rows * stride;
        memset(free, 0, n * sizeof *free), free[0] = 1.0;
        filter(n, ONE, t->zeros ? t->filters + 3 * i : s[i].mirrored, i ? last : free, free);
        last = free, rows++;
        /* C has a zero more than A has poles. */
        if (t->zeros ? 2 * i < t->order : s[i].size == 3) {
            double *later = Q + rows++ * stride;
            later[0] = 0.0, memcpy(later + 1, free, (n - 1) * sizeof *free);
        }
    }
    for (k = 0; k < levels; k++) {
        double *level = Q + rows++ * stride;
        for (i = 0; i < n; i++) {
            double place = k > 2 ? 2.0 * i / (t->longest - 1.0) - 1.0 : 1.0;
            level[i] = !k ? 1.0 : place * (k % 2 ? cos(t->hum * i) : sin(t->hum * i));
        }
        whiten(t, n, count, s, level);
    }
    if (!t->zeros) { /* else an offset of the effort dies out */
        double *sum = Q + rows++ * stride, total = 0.0;
        for (i = 0; i < n; i++)
            sum[i] = total += last[i];
    }
    for (j = 0; j < rows; j++) {
        double size = fmax(sqrt(dot(n, Q + j * stride, Q + j * stride)), 1e-300);
        scale(n, 1.0 / size, Q + j * stride, Q + j * stride);
    }
    orthonormal(n, 0, rows, stride, Q, W);
    rotate(rows, W, NULL);
    for (j = 0; j < rows; j++)
        sizes[j] = column_size(rows, W, j), largest = fmax(largest, sizes[j]);
    /* Rows turned to the directions that are left, in place. */
    for (j = 0; j < rows; j++)
        if (sizes[j] > NUISANCE_APART * largest) {
            for (i = 0; i < rows; i++)
                W[i * rows + rank] = W[i * rows + j] / sizes[j];
            rank++;
        }
    if (rank < rows) {
        double *turned = Q + rows * stride;
        for (j = 0; j < rank; j++) {
            memset(turned + j * stride, 0, n * sizeof *turned);
            for (k = 0; k < rows; k++)
                less(n, -W[k * rows + j], Q + k * stride, turned + j * stride);
        }
        memcpy(Q, turned, rank * stride * sizeof *Q);
    }
    return rank;
}

/* Basis of the regressors from one on, and their numbers of least squares. */
static void solve_rows(const FitTask *t, long from, double *triangle, const double *y,
                       double *numbers)
{
    double whole[MOST_COLUMNS * MOST_COLUMNS], sizes[MOST_COLUMNS], shares[MOST_COLUMNS];
    long i, k, m = t->terms, N = t->residuals;
    for (k = 0; k < m; k++) {
        const double *row = t->regressors + k * N;
        sizes[k] = fmax(sqrt(dot(N, row, row)), 1e-300);
        if (k >= from)
            scale(N, 1.0 / sizes[k], row, t->basis + k * N);
    }
    orthonormal(N, from, m, N, t->basis, triangle);
    for (k = 0; k < m; k++)
        shares[k] = dot(N, t->basis + k * N, y);
    memcpy(whole, triangle, m * m * sizeof *whole);
    solve(m, whole, shares, numbers);
    for (k = 0; k < m; k++)
        numbers[k] /= sizes[k];
}

/* A row of n samples from h on, so many late, without start states and offsets. */
static void late_row(const FitTask *t, long g, long h, long n, long late, const double *x,
                     double *row)
{
    long i;
    for (i = 0; i < n; i++)
        row[i] = i + h < late ? 0.0 : x[i + h - late];
    without(n, t->ranks[g], t->longest, t->nuisance + g * MOST_COLUMNS * t->longest, row);
}

static void differences(long n, double *x)
{
    for (; n > 1; n--)
        x[n - 1] -= x[n - 2];
}

/* Samples of the longest record, with its history. */
static long most_samples(const FitTask *t)
{
    long g, most = 1;
    for (g = 0; g < t->groups; g++)
        most = t->sizes[3 * g + 1] > most ? t->sizes[3 * g + 1] : most;
    return most;
}

/* Start states and offsets, the measurement without them, as the residual, and the undelayed terms
 * of the effort: (terms, samples of all); NULL where there is no memory. */
static double *filtered(const FitTask *t)
{
    Section s[MOST_SECTIONS];
    long count = sections_at(t->order, t->coordinates, s), g, k, r, at = 0, whole = 0;
    double *driven, *x, *y;
    for (g = 0; g < t->groups; g++)
        whole += t->sizes[3 * g] * t->sizes[3 * g + 1];
    if (!(driven = malloc((t->terms * whole + most_samples(t)) * sizeof *driven)))
        return NULL;
    x = driven, y = driven + t->terms * whole;
    for (g = 0; g < t->groups; g++) {
        long records = t->sizes[3 * g], samples = t->sizes[3 * g + 1], h = t->sizes[3 * g + 2];
        long n = samples - h;
        double *Q = t->nuisance + g * MOST_COLUMNS * t->longest;
        const double *effort = (const double *)t->signals[2 * g];
        const double *measurement = (const double *)t->signals[2 * g + 1];
        t->ranks[g] = nuisance_at(t, h, n, Q);
        for (r = 0; r < records; r++, at += n, x += samples) {
            memcpy(y, measurement + r * samples, samples * sizeof *y);
            whiten(t, samples, count, s, y);
            memcpy(t->residual + at, y + h, n * sizeof *y);
            without(n, t->ranks[g], t->longest, Q, t->residual + at);
            memcpy(x, effort + r * samples, samples * sizeof *x);
            drive(t, samples, count, s, x);
            for (k = 1; k < t->terms; k++) {
                memcpy(x + k * whole, x + (k - 1) * whole, samples * sizeof *x);
                differences(samples, x + k * whole);
            }
        }
    }
    return driven;
}

/* The regressors at some dead time, of the terms of the effort. */
static void regress(const FitTask *t, long dead, const double *driven)
{
    long g, k, r, at;
    for (k = 0; k < t->terms; k++)
        for (g = at = 0; g < t->groups; g++) {
            long samples = t->sizes[3 * g + 1], h = t->sizes[3 * g + 2], n = samples - h;
            for (r = 0; r < t->sizes[3 * g]; r++, at += n, driven += samples)
                late_row(t, g, h, n, dead + 1, driven, t->regressors + k * t->residuals + at);
        }
}

/* Returns zero, or one where there is no memory. */
__attribute__((visibility("default"))) int estune_prediction_errors(const FitTask *t)
{
    double triangle[MOST_COLUMNS * MOST_COLUMNS], *driven = filtered(t);
    long j;
    if (!driven)
        return 1;
    regress(t, t->dead, driven);
    free(driven);
    if (!t->given)
        solve_rows(t, 0, triangle, t->residual, t->numerator);
    for (j = 0; j < t->terms; j++)
        less(t->residuals, t->numerator[j], t->regressors + j * t->residuals, t->residual);
    return 0;
}

/* Sums of squares at some dead times. Returns zero, or one where there is no memory. */
__attribute__((visibility("default"))) int estune_delayed_errors(
    const FitTask *t, long delays, const long *dead, double *squares)
{
    double triangle[MOST_COLUMNS * MOST_COLUMNS], *driven = filtered(t);
    double *left = driven ? malloc(t->residuals * sizeof *left) : NULL;
    long d, j;
    for (d = 0; left && d < delays; d++) {
        regress(t, dead[d], driven);
        solve_rows(t, 0, triangle, t->residual, t->numerator);
        memcpy(left, t->residual, t->residuals * sizeof *left);
        for (j = 0; j < t->terms; j++)
            less(t->residuals, t->numerator[j], t->regressors + j * t->residuals, left);
        squares[d] = dot(t->residuals, left, left);
    }
    d = !left;
    free(left), free(driven);
    return d;
}

/* Slopes of the residual with a noise, the numerator held: differences to some moved filters, each
 * as `filters` of the task. A and C alone move, so that the signals pass P N once. */
__attribute__((visibility("default"))) int estune_noise_slopes(
    const FitTask *t, long moves, const double *filters, double step)
{
    long N = t->residuals, most = most_samples(t), g, i, k, r, v, begun = 0;
    double *Q = malloc((MOST_COLUMNS * t->longest + most) * sizeof *Q), *x, *signals = NULL;
    if (!Q)
        return 1;
    x = Q + MOST_COLUMNS * t->longest;
    for (g = 0; g < t->groups; g++) {
        long records = t->sizes[3 * g], samples = t->sizes[3 * g + 1], h = t->sizes[3 * g + 2];
        long n = samples - h, late = t->dead + 1, whole = records * samples;
        double *measured, *driven, *other = realloc(signals, 2 * whole * sizeof *other);
        if (!other) {
            free(signals), free(Q);
            return 1;
        }
        signals = measured = other, driven = measured + whole;
        memcpy(measured, (const double *)t->signals[2 * g + 1], whole * sizeof *measured);
        for (r = 0; r < records; r++) {
            const double *effort = (const double *)t->signals[2 * g] + r * samples;
            double *own = driven + r * samples;
            memset(own, 0, samples * sizeof *own);
            for (k = t->terms - 1; k >= 0; k--) {
                differences(samples, own);
                for (i = late; i < samples; i++)
                    own[i] += t->numerator[k] * effort[i - late];
            }
            colour(t, samples, own), colour(t, samples, measured + r * samples);
        }
        for (v = 0; v < moves; v++) {
            FitTask moved = *t;
            long at = begun, rank;
            moved.filters = filters + v * (3 * (t->zeros + t->over) + t->colours);
            rank = nuisance_at(&moved, h, n, Q);
            for (r = 0; r < records; r++, at += n) {
                double *slope = t->slopes + v * N + at;
                memcpy(x, measured + r * samples, samples * sizeof *x);
                for (i = 0; i < t->over; i++)
                    filter(samples, moved.filters + 3 * (t->zeros + i), ONE, x, x);
                less(samples, 1.0, driven + r * samples, x);
                for (i = 0; i < t->zeros; i++)
                    filter(samples, ONE, moved.filters + 3 * i, x, x);
                memcpy(slope, x + h, n * sizeof *slope);
                without(n, rank, t->longest, Q, slope);
                for (i = 0; i < n; i++)
                    slope[i] = (slope[i] - t->residual[at + i]) / step;
            }
        }
        begun += records * n;
    }
    free(signals), free(Q);
    return 0;
}

/* Slopes of the residual along the coordinates, the numerator held, with white noise. */
__attribute__((visibility("default"))) int estune_error_slopes(const FitTask *t)
{
    Section s[MOST_SECTIONS], high[MOST_SECTIONS], low[MOST_SECTIONS];
    double moved[2 * MOST_SECTIONS], *work;
    long count = sections_at(t->order, t->coordinates, s), c, g, i, k, r, most = most_samples(t);
    if (!(work = malloc(4 * most * sizeof *work)))
        return 1;
    for (c = 0; c < t->order; c++) {
        double change[3], turned[3];
        const Section *own = s + c / 2;
        long at = 0;
        memcpy(moved, t->coordinates, t->order * sizeof *moved);
        moved[c] = t->coordinates[c] + COORDINATE_STEP, sections_at(t->order, moved, high);
        moved[c] = t->coordinates[c] - COORDINATE_STEP, sections_at(t->order, moved, low);
        for (k = 0; k < 3; k++) {
            const Section *up = high + c / 2, *down = low + c / 2;
            change[k] = (up->taps[k] - down->taps[k]) / (2.0 * COORDINATE_STEP);
            turned[k] = (up->mirrored[k] - down->mirrored[k]) / (2.0 * COORDINATE_STEP);
        }
        for (g = 0; g < t->groups; g++) {
            long records = t->sizes[3 * g], samples = t->sizes[3 * g + 1];
            long h = t->sizes[3 * g + 2], n = samples - h;
            const double *Q = t->nuisance + g * MOST_COLUMNS * t->longest;
            const double *measurement = (const double *)t->signals[2 * g + 1];
            double *output = work, *slope = output + most, *one = slope + most, *two = one + most;
            for (r = 0; r < records; r++, at += n) {
                const double *measured = measurement + r * samples;
                memcpy(output, measured, samples * sizeof *output);
                less(n, 1.0, t->residual + at, output + h);
                filter(samples, turned, own->mirrored, output, slope);
                if (own->grows) {
                    memcpy(one, measured, samples * sizeof *one);
                    all_pass(samples, count, s, c / 2, one);
                    filter(samples, change, own->mirrored, one, one);
                    filter(samples, turned, own->mirrored, measured, two);
                    for (i = 0; i < samples; i++)
                        slope[i] += one[i] - two[i];
                }
                memcpy(t->slopes + c * t->residuals + at, slope + h, n * sizeof *slope);
                without(n, t->ranks[g], t->longest, Q, t->slopes + c * t->residuals + at);
            }
        }
    }
    free(work);
    return 0;
}

static double norm(long n, const double *x)
{
    return sqrt(dot(n, x, x));
}

/* R d = y behind (0) or R' d = y (1) of a triangle; along a row of zeros d is none. */
static void substitute(long n, const double *R, int transposed, const double *y, double *d)
{
    long i, j, k;
    for (k = 0; k < n; k++) {
        double sum = y[i = transposed ? k : n - 1 - k];
        for (j = transposed ? 0 : i + 1; j < (transposed ? i : n); j++)
            sum -= R[transposed ? j * n + i : i * n + j] * d[j];
        d[i] = R[i * n + i] ? sum / R[i * n + i] : 0.0;
    }
}

/* The step of least squares |R d - y|^2 + par |D d|^2, its size |D d|, and the size of its slope
 * along par, as `lmpar` of MINPACK needs them. */
static double damped(long n, const double *R, const double *y, const double *D, double par,
                     double *d, double *slope)
{
    double S[4 * MOST_SECTIONS * MOST_SECTIONS], rows[8 * MOST_SECTIONS * MOST_SECTIONS];
    double z[2 * MOST_SECTIONS], size = 0.0;
    long i, j;
    for (j = 0; j < n; j++)
        for (i = 0; i < n; i++) {
            rows[j * 2 * n + i] = i <= j ? R[i * n + j] : 0.0;
            rows[j * 2 * n + n + i] = i == j ? sqrt(par) * D[j] : 0.0;
        }
    orthonormal(2 * n, 0, n, 2 * n, rows, S);
    for (j = 0; j < n; j++)
        z[j] = dot(n, rows + j * 2 * n, y);
    substitute(n, S, 0, z, d);
    for (j = 0; j < n; j++)
        size += D[j] * d[j] * D[j] * d[j];
    size = sqrt(size);
    for (j = 0; j < n; j++)
        z[j] = size > 0.0 ? D[j] * D[j] * d[j] / size : 0.0;
    substitute(n, S, 1, z, z);
    *slope = norm(n, z);
    return size;
}

/* The step within a region |D d| <= delta, by More's method (`lmpar` of MINPACK); its par. */
static double bounded(long n, const double *R, const double *y, const double *D, double delta,
                      double par, double *d)
{
    double slope, low = 0.0, high = 0.0, last, over, size = damped(n, R, y, D, 0.0, d, &slope);
    long i, j, k, whole = 1;
    if (!((over = size - delta) > 0.1 * delta))
        return 0.0;
    for (j = 0; j < n; j++) {
        double sum = 0.0;
        for (i = 0; i <= j; i++)
            sum += R[i * n + j] * y[i];
        high += sum / D[j] * sum / D[j], whole = whole && R[j * n + j];
    }
    low = whole ? over / delta / slope / slope : 0.0;
    par = fmin(fmax(par, low), sqrt(high) / delta);
    par = par ? par : sqrt(high) / size;
    high = sqrt(high) / delta;
    for (k = 1;; k++) {
        par = par ? par : fmax(1e-300, 0.001 * high);
        last = over, size = damped(n, R, y, D, par, d, &slope), over = size - delta;
        if (fabs(over) <= 0.1 * delta || (!low && over <= last && last < 0.0) || k == 10)
            return par;
        if (over > 0.0)
            low = fmax(low, par);
        else
            high = fmin(high, par);
        par = fmax(low, par + over / delta / slope / slope);
    }
}

/* The poles of least squares from those of the task on, with white noise, by Levenberg and
 * Marquardt as `lmder` of MINPACK has it. Returns one where there is no memory. */
__attribute__((visibility("default"))) int estune_improve(
    FitTask *t, double tolerance, double nearness, double flat, long most, double *squares)
{
    enum { MOST = 2 * MOST_SECTIONS };
    double *x = (double *)t->coordinates, kept[MOST], D[MOST], d[MOST], y[MOST], sizes[MOST];
    double R[MOST * MOST], par = 0.0, delta = 0.0, size, last, length = 0.0;
    long n = t->order, N = t->residuals, i, j, asked = 1, first = 1, failed, done = 0;
    double *slopes = t->slopes = malloc(n * N * sizeof *slopes);
    failed = !slopes || estune_prediction_errors(t);
    size = failed ? 0.0 : norm(N, t->residual);
    while (!done && !failed && !(failed = estune_error_slopes(t))) {
        double gradient = 0.0, ratio = 0.0;
        for (j = 0; j < n; j++) { /* the numerator follows the poles (Kaufman) */
            without(N, t->terms, N, t->basis, slopes + j * N);
            sizes[j] = norm(N, slopes + j * N);
        }
        orthonormal(N, 0, n, N, slopes, R);
        for (j = 0; j < n; j++)
            y[j] = dot(N, slopes + j * N, t->residual);
        for (j = 0; j < n; j++) {
            double sum = 0.0;
            for (i = 0; i <= j; i++)
                sum += R[i * n + j] * y[i] / size;
            gradient = sizes[j] ? fmax(gradient, fabs(sum / sizes[j])) : gradient;
            D[j] = first ? (sizes[j] ? sizes[j] : 1.0) : fmax(D[j], sizes[j]);
            kept[j] = D[j] * x[j];
        }
        if (first)
            length = norm(n, kept), delta = length ? 100.0 * length : 100.0;
        if (gradient <= flat)
            break;
        while (!done && !failed && !(ratio >= 1e-4)) {
            double step = 0.0, linear = 0.0, actual = -1.0, slope, foreseen;
            memcpy(kept, x, n * sizeof *x);
            par = bounded(n, R, y, D, delta, par, d);
            for (i = 0; i < n; i++) {
                double sum = 0.0;
                for (j = i; j < n; j++)
                    sum += R[i * n + j] * d[j];
                linear += sum / size * sum / size, step += D[i] * d[i] * D[i] * d[i];
                x[i] -= d[i];
            }
            step = sqrt(step), delta = first ? fmin(delta, step) : delta;
            failed = estune_prediction_errors(t), asked++;
            last = norm(N, t->residual);
            if (0.1 * last < size)
                actual = 1.0 - last / size * last / size;
            slope = par * step / size * step / size;
            foreseen = linear + 2.0 * slope, slope = -(linear + slope);
            ratio = foreseen ? actual / foreseen : 0.0;
            if (ratio <= 0.25) {
                double by = actual >= 0.0 ? 0.5 : 0.5 * slope / (slope + 0.5 * actual);
                by = 0.1 * last >= size || by < 0.1 ? 0.1 : by;
                delta = by * fmin(delta, 10.0 * step), par /= by;
            } else if (!par || ratio >= 0.75)
                delta = 2.0 * step, par *= 0.5;
            if (ratio >= 1e-4) {
                for (j = 0; j < n; j++)
                    y[j] = D[j] * x[j];
                length = norm(n, y), size = last, first = 0;
            } else
                memcpy(x, kept, n * sizeof *x);
            done = (fabs(actual) <= tolerance && foreseen <= tolerance && ratio <= 2.0)
                || delta <= nearness * length || asked >= most;
        }
    }
    *squares = size * size;
    free(slopes);
    return failed;
}

/* Numbers of A and B together at some dead times, as of `growing_poles`: terms are 2 order + 1.
 * Returns zero, or one where there is no memory. */
__attribute__((visibility("default"))) int estune_filtered_errors(
    const FitTask *t, long delays, const long *dead, double *squares, double *numbers)
{
    Section s[MOST_SECTIONS];
    double triangle[MOST_COLUMNS * MOST_COLUMNS], *work;
    long n_poles = t->order, count = sections_at(n_poles, t->coordinates, s), N = t->residuals;
    long d, g, i, k, r, most = most_samples(t);
    if (!(work = malloc((most + N) * sizeof *work)))
        return 1;
    for (d = 0; d < delays; d++) {
        long at = 0, from = d ? n_poles : 0;
        double *x = work, *left = work + most, *found = numbers + d * t->terms;
        for (g = 0; g < t->groups; g++) {
            long records = t->sizes[3 * g], samples = t->sizes[3 * g + 1];
            long h = t->sizes[3 * g + 2], n = samples - h;
            if (!d)
                t->ranks[g] = nuisance_at(t, h, n, t->nuisance + g * MOST_COLUMNS * t->longest);
            for (r = 0; r < records; r++, at += n)
                for (k = from ? 1 : 0; k < 2; k++) { /* the past of the measurement; the effort */
                    const double *signal = (const double *)t->signals[2 * g + 1 - k] + r * samples;
                    double *rows = t->regressors + (k ? n_poles * N : 0) + at;
                    if (!k)
                        late_row(t, g, h, n, 0, signal, t->residual + at);
                    memcpy(x, signal, samples * sizeof *x);
                    for (i = 0; i < count; i++)
                        filter(samples, ONE, s[i].mirrored, x, x);
                    for (i = 0; i < n_poles + k; i++, rows += N) {
                        late_row(t, g, h, n, k ? dead[d] + 1 : 1, x, rows);
                        differences(samples, x);
                    }
                }
        }
        for (i = 0; !d && i < n_poles * N; i++)
            t->regressors[i] = -t->regressors[i];
        solve_rows(t, from, triangle, t->residual, found);
        memcpy(left, t->residual, N * sizeof *left);
        for (k = 0; k < t->terms; k++)
            less(N, found[k], t->regressors + k * N, left);
        squares[d] = dot(N, left, left);
    }
    free(work);
    return 0;
}

/* Friction on masses on springs, as of `friction_motion.friction_force`; (masses, records,
 * samples). */
__attribute__((visibility("default"))) void estune_friction(
    long masses, long records, long samples, const double *effort, const double *a,
    const double *most, const double *rest, double *taken)
{
    long m, r, i;
    for (m = 0; m < masses; m++)
        for (r = 0; r < records; r++) {
            double unit = a[3 * m] + a[3 * m + 1] + a[3 * m + 2], limit = unit * most[m];
            double first = -(1.0 + a[3 * m + 1]), second = -a[3 * m + 2];
            double now = rest[m * records + r], before = now;
            const double *pushed = effort + r * samples;
            double *off = taken + (m * records + r) * samples;
            for (i = 0; i < samples; i++) {
                double step = first * now + second * before + unit * pushed[i];
                double held = step > limit ? limit : step < -limit ? -limit : step;
                before = now, now += step - held, off[i] = held / unit;
            }
        }
}
