/* Poles by their coordinates, as in `poles`, which says why. The first part of each C source. */

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define LEAST -25.0
#define GREATEST 6.0
#define OUTSIDE 100.0
#define MOST_GROWTH 1.0
#define MOST_SECTIONS 16

static double clipped(double x, double low, double high)
{
    return x < low ? low : x > high ? high : x;
}

static int grows(double x)
{
    return OUTSIDE / 2.0 < x && x < 1.5 * OUTSIDE;
}

static double growth(double x)
{
    return exp(clipped(x - OUTSIDE, LEAST, MOST_GROWTH));
}

/* Logarithms of a pair of poles. */
static void pair(double x, double y, double *re, double *im)
{
    double w, z, turn;
    if (grows(x) && !grows(y)) {
        re[0] = growth(x), re[1] = -exp(clipped(y, LEAST, GREATEST)), im[0] = im[1] = 0.0;
        return;
    }
    if (grows(x)) {
        pair(x - OUTSIDE, y - OUTSIDE, re, im);
        re[0] = fmin(-re[0], exp(MOST_GROWTH)), re[1] = fmin(-re[1], exp(MOST_GROWTH));
        im[0] = -im[0], im[1] = -im[1];
        return;
    }
    w = exp(clipped(x, LEAST, GREATEST)), z = exp(clipped(y, LEAST, -LEAST));
    if (z < 1.0) {
        turn = w * sqrt(1.0 - z * z);
        re[0] = re[1] = -z * w, im[0] = turn, im[1] = -turn;
        return;
    }
    turn = w * sqrt(z * z - 1.0);
    re[0] = -w * w / (z * w + turn), re[1] = -(z * w + turn), im[0] = im[1] = 0.0;
}

/* Logarithm of a single pole. */
static double single(double x)
{
    return grows(x) ? growth(x) : -exp(clipped(x, LEAST, GREATEST));
}
