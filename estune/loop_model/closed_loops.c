/* Closed loops of linear models and controllers: margins over frequency, answers over time.

The same as `margins.robustness_of` and `model.ClosedLoop`, which say why; loops of one order and
dead time at once. Polynomials are in q^-1 but where `powers` are of d = 1 - q^-1. With A of the
poles, B of the numerator and S, T, R of the controller the characteristic polynomial is
A R + q^-late B S. Python checks all sizes. */

#define PI 3.14159265358979323846
#define BANDS 16
#define ZOOMED 13
#define ZOOM_REACH 0.6
#define MOST_TERMS 64

typedef struct {
    long models, laws, loops;             /* models and laws: one for all loops, or one each */
    long order, terms, dead, law_terms;   /* S, T and R have the same number of terms */
    long angles, offsets, before, samples; /* before and from the step on */
    long drawn;                           /* samples of the noise; zero for its variance */
    const double *coordinates;            /* (models, order) */
    const double *numerators;             /* (models, terms), powers of d */
    const double *S, *T, *R;              /* (laws, law_terms) */
    const double *filters;                /* (laws, 3): numerator, and what is kept of the last */
    const double *grid;                   /* (5, angles): theta, sine and cosine of its half, */
    const double *about;                  /* cosine and sine of late theta; (offsets,) */
    const double *setpoint, *load, *noise; /* (samples,), the load or NULL; (drawn,) */
    double *stable, *margin, *peaks;      /* (loops,), (loops,), (loops, BANDS) */
    double *output, *effort;              /* (loops, before + samples); NULL where only margins are asked */
    double *noise_gains;                  /* (loops, 2): over samples, or (loops, 2, drawn) */
} Task;

typedef struct {
    long sections, pairs;
    double powers[MOST_SECTIONS][3], log_re[MOST_SECTIONS][2], log_im[MOST_SECTIONS][2];
    double A[MOST_TERMS], B[MOST_TERMS];
    const double *numerator;
} Plant;

static void multiply(double *product, long degree, const double *by, long more)
{
    long i, j;
    for (i = degree + more; i >= 0; i--) {
        double sum = 0.0;
        for (j = 0; j <= more; j++)
            if (i - j >= 0 && i - j <= degree)
                sum += by[j] * product[i - j];
        product[i] = sum;
    }
}

static void read_plant(const Task *t, long model, Plant *p)
{
    const double *x = t->coordinates + model * t->order;
    double power[MOST_TERMS] = {1.0}, step[2] = {1.0, -1.0};
    long i, k, n = 0;
    p->pairs = t->order / 2, p->sections = p->pairs + t->order % 2;
    memset(p->A, 0, sizeof p->A), memset(p->B, 0, sizeof p->B);
    p->A[0] = 1.0;
    for (i = 0; i < p->sections; i++) {
        double taps[3] = {1.0, 0.0, 0.0}, *powers = p->powers[i];
        if (i < p->pairs) {
            double *re = p->log_re[i], *im = p->log_im[i], r[2], m[2], ur[2], ui[2];
            pair(x[2 * i], x[2 * i + 1], re, im);
            for (k = 0; k < 2; k++) {
                double half = sin(0.5 * im[k]), size = exp(re[k]);
                r[k] = size * cos(im[k]), m[k] = size * sin(im[k]);
                ur[k] = 2.0 * half * half - expm1(re[k]) * cos(im[k]), ui[k] = -m[k];
            }
            taps[1] = -(r[0] + r[1]);
            taps[2] = powers[2] = r[0] * r[1] - m[0] * m[1];
            powers[0] = ur[0] * ur[1] - ui[0] * ui[1];
            powers[1] = r[0] * ur[1] - m[0] * ui[1] + r[1] * ur[0] - m[1] * ui[0];
            multiply(p->A, n, taps, 2), n += 2;
        } else {
            double log_p = single(x[2 * i]);
            taps[1] = -exp(log_p);
            powers[0] = -expm1(log_p), powers[1] = -taps[1], powers[2] = 0.0;
            multiply(p->A, n, taps, 1), n += 1;
        }
    }
    p->numerator = t->numerators + model * t->terms;
    for (k = 0; k < t->terms; k++) {
        for (i = 0; i <= k; i++)
            p->B[i] += p->numerator[k] * power[i];
        if (k + 1 < t->terms)
            multiply(power, k, step, 1);
    }
}

/* Real polynomial of complex x at n points. */
static void polynomial(long terms, const double *c, long n, const double *xr, const double *xi,
                       double *yr, double *yi)
{
    long i, k;
    for (i = 0; i < n; i++)
        yr[i] = c[terms - 1], yi[i] = 0.0;
    for (k = terms - 2; k >= 0; k--)
        for (i = 0; i < n; i++) {
            double r = yr[i] * xr[i] - yi[i] * xi[i] + c[k];
            yi[i] = yr[i] * xi[i] + yi[i] * xr[i], yr[i] = r;
        }
}

static void times(long n, const double *xr, const double *xi, double *yr, double *yi)
{
    long i;
    for (i = 0; i < n; i++) {
        double r = yr[i] * xr[i] - yi[i] * xi[i];
        yi[i] = yr[i] * xi[i] + yi[i] * xr[i], yr[i] = r;
    }
}

/* Columns of a grid of n angles, each of n numbers. */
enum { THETA, HALF_SINE, HALF_COSINE, LATE_COSINE, LATE_SINE,
       DR, DI, ZR, ZI, AR, AI, BR, BI, FR, FI, KR, KI, TR, TI, COLUMNS };
#define AT(column) (g + (column) * n)

/* d, q^-1, A and q^-late B at the angles of a grid. */
static void plant_at(const Plant *p, long terms, long n, double *g)
{
    long i;
    for (i = 0; i < n; i++) {
        double s = AT(HALF_SINE)[i];
        AT(DR)[i] = 2.0 * s * s, AT(DI)[i] = 2.0 * s * AT(HALF_COSINE)[i];
        AT(ZR)[i] = 1.0 - AT(DR)[i], AT(ZI)[i] = -AT(DI)[i];
    }
    for (i = 0; i < p->sections; i++) {
        long few = i < p->pairs ? 3 : 2;
        double *r = i ? AT(TR) : AT(AR), *m = i ? AT(TI) : AT(AI);
        polynomial(few, p->powers[i], n, AT(DR), AT(DI), r, m);
        if (i)
            times(n, r, m, AT(AR), AT(AI));
    }
    polynomial(terms, p->numerator, n, AT(DR), AT(DI), AT(BR), AT(BI));
    for (i = 0; i < n; i++) {
        double r = AT(BR)[i], m = AT(BI)[i], c = AT(LATE_COSINE)[i], s = AT(LATE_SINE)[i];
        AT(BR)[i] = r * c + m * s, AT(BI)[i] = m * c - r * s;
    }
}

/* A R and q^-late B S at the angles of a grid. */
static void law_at(const Task *t, long law, long n, double *g)
{
    polynomial(t->law_terms, t->R + law * t->law_terms, n, AT(ZR), AT(ZI), AT(FR), AT(FI));
    times(n, AT(AR), AT(AI), AT(FR), AT(FI));
    polynomial(t->law_terms, t->S + law * t->law_terms, n, AT(ZR), AT(ZI), AT(KR), AT(KI));
    times(n, AT(BR), AT(BI), AT(KR), AT(KI));
}

static int rising(const void *one, const void *other)
{
    double a = *(const double *)one, b = *(const double *)other;
    return (a > b) - (a < b);
}

/* The angles of all models with those about the resonances of one, in order; n of them. */
static void fill_grid(const Task *t, const Plant *p, long n, double *g, double *extra)
{
    long i, j, k, at, rows = t->angles, more = 0;
    double late = (double)(t->dead + 1);
    for (i = 0; i < p->pairs; i++)
        for (k = 0; k < 2; k++) {
            int swings = p->log_im[i][k] > 0.0;
            double middle = swings ? p->log_im[i][k] : PI;
            double width = fmax(swings ? fabs(p->log_re[i][k]) : 0.0, 1e-6);
            for (j = 0; j < t->offsets; j++)
                extra[more++] = clipped(middle + width * t->about[j], t->grid[0], PI);
        }
    qsort(extra, more, sizeof *extra, rising);
    for (i = j = 0, at = 0; at < n; at++) {
        if (j < more && (i >= rows || extra[j] < t->grid[i])) {
            double theta = extra[j++];
            AT(THETA)[at] = theta;
            AT(HALF_SINE)[at] = sin(0.5 * theta), AT(HALF_COSINE)[at] = cos(0.5 * theta);
            AT(LATE_COSINE)[at] = cos(late * theta), AT(LATE_SINE)[at] = sin(late * theta);
        } else {
            for (k = THETA; k <= LATE_SINE; k++)
                AT(k)[at] = t->grid[k * rows + i];
            i++;
        }
    }
}

static int is_stable(const Task *t, const Plant *p, long law, long n, const double *g)
{
    const double *S = t->S + law * t->law_terms, *R = t->R + law * t->law_terms;
    double poles = 1.0, S_sum = 0.0, R_sum = 0.0;
    long i, turns = 0;
    for (i = 0; i < p->sections; i++)
        poles *= p->powers[i][0];
    for (i = 0; i < t->law_terms; i++)
        S_sum += S[i], R_sum += R[i];
    for (i = 0; i + 1 < n; i++) {
        double y = AT(FI)[i] + AT(KI)[i], next = AT(FI)[i + 1] + AT(KI)[i + 1];
        if ((y >= 0.0) != (next >= 0.0)) {
            double x = AT(FR)[i] + AT(KR)[i], x_next = AT(FR)[i + 1] + AT(KR)[i + 1];
            double turned = x * next - x_next * y;
            turns += (y >= 0.0 && turned > 0.0) - (next >= 0.0 && turned < 0.0);
        }
    }
    return poles * R_sum + p->numerator[0] * S_sum > 0.0
           && AT(FR)[n - 1] + AT(KR)[n - 1] > 0.0 && !turns;
}

static double phase_margin(long n, const double *g)
{
    double least = HUGE_VAL;
    long i;
    for (i = 0; i + 1 < n; i++) {
        double F = AT(FR)[i] * AT(FR)[i] + AT(FI)[i] * AT(FI)[i];
        double K = AT(KR)[i] * AT(KR)[i] + AT(KI)[i] * AT(KI)[i];
        double F_next = AT(FR)[i + 1] * AT(FR)[i + 1] + AT(FI)[i + 1] * AT(FI)[i + 1];
        double K_next = AT(KR)[i + 1] * AT(KR)[i + 1] + AT(KI)[i + 1] * AT(KI)[i + 1];
        if ((K > F) != (K_next > F_next)) {
            double before = log(K / F), after = log(K_next / F_next);
            double fr = AT(FR)[i], fi = AT(FI)[i], kr = AT(KR)[i], ki = AT(KI)[i];
            double hr = kr * fr + ki * fi, hi = ki * fr - kr * fi;
            double gr = AT(KR)[i + 1] * AT(FR)[i + 1] + AT(KI)[i + 1] * AT(FI)[i + 1];
            double gi = AT(KI)[i + 1] * AT(FR)[i + 1] - AT(KR)[i + 1] * AT(FI)[i + 1];
            double turn = atan2(gi * hr - gr * hi, gr * hr + gi * hi);
            double angle = fabs(atan2(-hi, -hr) + before / (before - after) * turn);
            least = fmin(least, angle * 180.0 / PI);
        }
    }
    return least;
}

/* |1 + L|^2 at one angle of a grid. */
static double size_at(long n, const double *g, long i)
{
    double x = AT(FR)[i] + AT(KR)[i], y = AT(FI)[i] + AT(KI)[i];
    return (x * x + y * y) / (AT(FR)[i] * AT(FR)[i] + AT(FI)[i] * AT(FI)[i]);
}

static long lowest_of(long n, const double *g, long first, long last)
{
    long i, at = first;
    double least = size_at(n, g, first);
    for (i = first + 1; i <= last; i++) {
        double size = size_at(n, g, i);
        if (size < least)
            least = size, at = i;
    }
    return at;
}

/* Lowest |1 + L| about an inner angle of a grid, on a second grid. */
static double refined(const Task *t, const Plant *p, long law, double begin, double middle,
                      double end)
{
    enum { n = ZOOMED };
    double g[COLUMNS * ZOOMED], late = (double)(t->dead + 1), left, own, right, bend;
    long i, at, inner;
    for (i = 0; i < n; i++) {
        double share = ZOOM_REACH * (i - n / 2) / (n / 2);
        double theta = middle + share * (share < 0.0 ? middle - begin : end - middle);
        AT(HALF_SINE)[i] = sin(0.5 * theta), AT(HALF_COSINE)[i] = cos(0.5 * theta);
        AT(LATE_COSINE)[i] = cos(late * theta), AT(LATE_SINE)[i] = sin(late * theta);
    }
    plant_at(p, t->terms, n, g);
    law_at(t, law, n, g);
    at = lowest_of(n, g, 0, n - 1);
    inner = at < 1 ? 1 : at > n - 2 ? n - 2 : at;
    left = 0.5 * log(size_at(n, g, inner - 1)), own = 0.5 * log(size_at(n, g, inner));
    right = 0.5 * log(size_at(n, g, inner + 1)), bend = left - 2.0 * own + right;
    if (inner == at && bend > 0.0)
        return exp(own - (left - right) * (left - right) / (8.0 * bend));
    return sqrt(size_at(n, g, at));
}

static void peaks_of(const Task *t, const Plant *p, long law, long n, const double *g,
                     double *peaks)
{
    long band;
    for (band = 0; band < BANDS; band++) {
        long first = (long)(band * ((n - 1) / (double)BANDS));
        long last = band + 1 < BANDS ? (long)((band + 1) * ((n - 1) / (double)BANDS)) : n - 1;
        long at = lowest_of(n, g, first, last);
        if (first < at && at < last)
            peaks[band] = 1.0 / refined(t, p, law, AT(THETA)[at - 1], AT(THETA)[at],
                                        AT(THETA)[at + 1]);
        else
            peaks[band] = 1.0 / sqrt(size_at(n, g, at));
    }
}

typedef double Two __attribute__((vector_size(16)));

typedef struct {
    long late, ar, bs; /* terms of A R and of B S */
    double AR[MOST_TERMS], BS[MOST_TERMS];
} Characteristic;

/* A signal over the characteristic polynomial, and two polynomials of it, the first late. */
typedef struct {
    const double *x, *B, *A;
    double *of_B, *of_A;
} Lane;

/* Two lanes of n samples at once, in several sums, for each waits for its last term; w has zeros
 * before its first sample. */
static void drive(const Characteristic *c, const Lane *p, const Lane *q, long n, Two *w)
{
    Two A[MOST_TERMS], B[MOST_TERMS];
    long i, j;
    for (j = 0; j < MOST_TERMS; j++)
        A[j] = (Two){p->A[j], q->A[j]}, B[j] = (Two){p->B[j], q->B[j]};
    for (i = 0; i < n; i++) {
        const Two *before = w + i - c->late;
        Two late = {0.0, 0.0}, own = late, of_B = late, of_A = late, now = {p->x[i], q->x[i]};
        for (j = 0; j < c->bs; j++)
            late += c->BS[j] * before[-j], of_B += B[j] * before[-j];
        for (j = c->ar - 1; j > 0; j--)
            own += c->AR[j] * w[i - j], of_A += A[j] * w[i - j];
        w[i] = now - late - own, of_A += A[0] * w[i];
        p->of_B[i] = of_B[0], p->of_A[i] = of_A[0];
        q->of_B[i] = of_B[1], q->of_A[i] = of_A[1];
    }
}

static void respond(const Task *t, const Plant *p, long law, long loop, double *work)
{
    long i, n = t->samples, k = t->law_terms, longest = n > t->drawn ? n : t->drawn;
    long all = t->before + n, history;
    const double *f = t->filters + 3 * law, *by[3];
    double of_A[3][MOST_TERMS], of_B[3][MOST_TERMS], kept = 0.0;
    double *y = t->output + loop * all + t->before, *u = t->effort + loop * all + t->before;
    double *one, *other, *filtered, *impulse;
    Characteristic c;
    Two *w = (Two *)work;
    Lane setpoint, load, noise;
    by[0] = t->R + law * k, by[1] = t->S + law * k, by[2] = t->T + law * k;
    for (i = 0; i < 3; i++) {
        memcpy(of_A[i], p->A, sizeof p->A), multiply(of_A[i], t->order, by[i], k - 1);
        memcpy(of_B[i], p->B, sizeof p->B), multiply(of_B[i], t->terms - 1, by[i], k - 1);
    }
    memcpy(c.AR, of_A[0], sizeof c.AR), memcpy(c.BS, of_B[1], sizeof c.BS);
    c.late = t->dead + 1, c.bs = t->terms + k - 1, c.ar = t->order + k;
    history = c.late + c.bs + c.ar;
    memset(w, 0, history * sizeof *w), w += history;
    one = (double *)(w + longest), other = one + longest;
    filtered = other + longest, impulse = filtered + longest;
    memset(y - t->before, 0, t->before * sizeof *y);
    memset(u - t->before, 0, t->before * sizeof *u);
    memset(impulse, 0, longest * sizeof *impulse), impulse[0] = 1.0;
    for (i = 0; i < n; i++) {
        kept = f[0] * t->setpoint[i] + f[1] * (i ? t->setpoint[i - 1] : 0.0) + f[2] * kept;
        filtered[i] = kept;
    }
    setpoint = (Lane){filtered, of_B[2], of_A[2], y, u};
    load = (Lane){t->load, of_B[0], of_A[0], one, other};
    noise = (Lane){t->drawn ? t->noise : impulse, of_B[1], of_A[1], one, other};
    drive(&c, &setpoint, t->load ? &load : &noise, n, w);
    for (i = 0; t->load && i < n; i++) /* - q^-late B S w is A R w less the load */
        y[i] += one[i], u[i] += other[i] - t->load[i];
    if (t->drawn) {
        double *measured = t->noise_gains + 2 * loop * t->drawn, *moved = measured + t->drawn;
        noise.of_B = measured, noise.of_A = moved;
        drive(&c, &noise, &noise, t->drawn, w);
        for (i = 0; i < t->drawn; i++) /* A R w is the noise less q^-late B S w */
            measured[i] = t->noise[i] - measured[i], moved[i] = -moved[i];
    } else if (!t->load) {
        double error = 0.0, moves = 0.0;
        for (i = 0; i < n; i++) {
            double move = other[i] - (i ? other[i - 1] : 0.0), measured = impulse[i] - one[i];
            error += measured * measured, moves += move * move;
        }
        t->noise_gains[2 * loop] = error, t->noise_gains[2 * loop + 1] = moves;
    }
}

/* The filter of the setpoint moves no margin, and slopes along it are asked for. */
static int is_first_but_for_its_filter(const Task *t, long law)
{
    long k = t->law_terms;
    size_t size = k * sizeof(double);
    return !memcmp(t->R + law * k, t->R, size) && !memcmp(t->S + law * k, t->S, size);
}

/* Returns zero, or one where there is no memory. */
__attribute__((visibility("default"))) int estune_closed_loops(const Task *t)
{
    long i, model = -1, law, extra = t->order / 2 * 2 * t->offsets, n = t->angles + extra;
    long longest = t->samples > t->drawn ? t->samples : t->drawn;
    double *g = malloc((COLUMNS * n + extra + 1) * sizeof *g);
    double *work = malloc((6 * longest + 2 * (t->dead + 3 * MOST_TERMS)) * sizeof *work);
    Plant p;
    for (i = 0; g && work && i < t->loops; i++) {
        if (model < 0 || t->models > 1) {
            model = i;
            read_plant(t, model, &p);
            fill_grid(t, &p, n, g, g + COLUMNS * n);
            plant_at(&p, t->terms, n, g);
        }
        law = t->laws > 1 ? i : 0;
        if (i && t->models == 1 && is_first_but_for_its_filter(t, law)) {
            t->stable[i] = t->stable[0], t->margin[i] = t->margin[0];
            memcpy(t->peaks + i * BANDS, t->peaks, BANDS * sizeof *t->peaks);
        } else {
            law_at(t, law, n, g);
            t->stable[i] = is_stable(t, &p, law, n, g);
            if (t->stable[i]) {
                t->margin[i] = phase_margin(n, g);
                peaks_of(t, &p, law, n, g, t->peaks + i * BANDS);
            }
        }
        if (t->stable[i] && t->output)
            respond(t, &p, law, i, work);
    }
    i = !(g && work);
    free(g), free(work);
    return (int)i;
}
