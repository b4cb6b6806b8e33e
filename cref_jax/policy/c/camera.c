
/* ---------------------------------------------------------------- depth frames */

#if CREF_SEES

enum { PIXELS = CREF_ROWS * CREF_COLUMNS };

static bool is_known(float depth)
{
    return depth > 0.0f; /* and no NaN */
}

/* Check whether joints move while the camera sends the same frame again and again. */
static bool is_frozen(cref_policy *p, const float *depth)
{
    if (p->has_frame && memcmp(depth, p->frame, sizeof p->frame) == 0) /* NaN equals itself */
        return ++p->repeats >= FROZEN_FRAMES &&
               compare_poses(p->q, p->frame_q) > (float)FROZEN_MOTION;
    p->repeats = 0;
    p->has_frame = true;
    memcpy(p->frame, depth, sizeof p->frame);
    memcpy(p->frame_q, p->q, sizeof p->q);
    return false;
}

/* Compute the mean of some rows, m. */
static double average_rows(const float *seen, int first, int count)
{
    double sum = 0.0;
    for (int i = first * CREF_COLUMNS; i < (first + count) * CREF_COLUMNS; i++)
        sum += seen[i];
    return sum / (count * CREF_COLUMNS);
}

/* Check whether the median of `count` values is below a bound, without sorting them. */
static bool median_is_below(const float *values, int count, float bound)
{
    float below = -INFINITY, above = INFINITY; /* the two nearest to the bound */
    int fewer = 0;
    for (int i = 0; i < count; i++) {
        if (values[i] < bound) {
            fewer++;
            below = fmaxf(below, values[i]);
        } else {
            above = fminf(above, values[i]);
        }
    }
    if (2 * fewer == count) /* they stand in the middle: the median is their mean */
        return 0.5f * (below + above) < bound;
    return 2 * fewer > count;
}

/* Notice a camera that shows no ground ahead; `seen` is in m, CREF_D_MAX where nothing is. */
static unsigned look_through(cref_policy *p, const float *depth, const float *seen)
{
    if (is_frozen(p, depth))
        return CREF_FROZEN_DEPTH;
    int seen_near = 0;
    for (int i = 0; i < PIXELS; i++)
        seen_near += seen[i] < CREF_D_MAX;
    if ((double)seen_near / PIXELS < LEAST_SEEN)
        return CREF_SEES_NOTHING;
    const int sixth = CREF_ROWS / 6, third = CREF_ROWS / 3;
    const float *bottom = seen + (CREF_ROWS - sixth) * CREF_COLUMNS;
    if (median_is_below(bottom, sixth * CREF_COLUMNS, (float)NEAREST_GROUND))
        return CREF_SEES_TOO_NEAR;
    const double top = average_rows(seen, 0, third);
    const double drop = top - average_rows(seen, CREF_ROWS - third, third);
    p->way_up |= drop > UPSIDE_DOWN; /* from then on what is near and high is in the way */
    return drop < -UPSIDE_DOWN && !p->way_up ? CREF_CAMERA_TURNED : CREF_OK;
}

/* Interpolate linearly at `at` between the known values at `left` and `right`, which may be -1 and
   `end` where there is none. */
static double interpolate(const float *values, int stride, int left, int right, int end, int at)
{
    if (left < 0)
        return values[right * stride];
    if (right == end)
        return values[left * stride];
    const double from = values[left * stride], to = values[right * stride];
    return (to - from) / (right - left) * (at - left) + from;
}

/* Interpolate 1 / share of a row where depth is not known; false if it is known nowhere. */
static bool fill_row(const float *depth, const float *share, float *nearness)
{
    int left = -1;
    for (int c = 0; c < CREF_COLUMNS; c++)
        nearness[c] = 1.0f / share[c];
    for (int right = 0; right <= CREF_COLUMNS; right++) {
        if (right < CREF_COLUMNS ? !is_known(depth[right]) : left < 0)
            continue;
        for (int c = left + 1; c < right; c++)
            nearness[c] = (float)interpolate(nearness, 1, left, right, CREF_COLUMNS, c);
        left = right;
    }
    return left >= 0;
}

/* Fill holes of `share`, depth / CREF_D_MAX, and subtract 0.5: along rows, then columns.

   1 / depth of a plane is linear in the image, so level ground is filled in exactly. `nearness` is
   room for an image. */
static void fill_holes(const float *depth, float *share, float *nearness)
{
    bool known[CREF_ROWS];
    for (int r = 0; r < CREF_ROWS; r++) {
        const int row = r * CREF_COLUMNS;
        known[r] = fill_row(depth + row, share + row, nearness + row);
    }
    int above = -1, below = 0; /* the nearest rows with known pixels, this one and after it */
    for (int r = 0; r < CREF_ROWS; r++) {
        if (known[r])
            above = r;
        while (below < CREF_ROWS && (below <= r || !known[below]))
            below++;
        for (int c = 0; c < CREF_COLUMNS; c++) {
            const int i = r * CREF_COLUMNS + c;
            double filled = share[i];
            if (!is_known(depth[i]))
                filled = 1.0 / interpolate(nearness + c, CREF_COLUMNS, above, below, CREF_ROWS, r);
            share[i] = (float)(filled - 0.5);
        }
    }
}

#if CREF_WINDOW > 1
/* Compute the smallest of CREF_WINDOW values around each of a line, fewer at its ends. */
static void find_nearest(const float *line, int count, int step, float *out)
{
    for (int i = 0; i < count; i++) {
        const int first = i - CREF_WINDOW / 2;
        float nearest = INFINITY;
        for (int k = first < 0 ? 0 : first; k < first + CREF_WINDOW && k < count; k++)
            nearest = fminf(nearest, line[k * step]);
        out[i * step] = nearest;
    }
}
#endif

/* Round to the nearest float16, ties to even: the network was trained on such images. */
static float round_to_half(float x)
{
    uint32_t bits;
    memcpy(&bits, &x, sizeof bits);
    const uint32_t sign = bits & 0x80000000u, size = bits & 0x7fffffffu;
    if (size > 0x7f800000u)
        return x; /* NaN */
    if (size < 0x38800000u) /* below 2^-14: a multiple of 2^-24 */
        return nearbyintf(x * 16777216.0f) / 16777216.0f;
    if (size >= 0x477ff000u) /* 65520 and more */
        bits = sign | 0x7f800000u;
    else /* 13 bits less */
        bits = sign | ((size + 0x0fffu + (size >> 13 & 1u)) & ~0x1fffu);
    memcpy(&x, &bits, sizeof x);
    return x;
}

/* Check a frame and compute the network's image of it, in work[0]. */
static unsigned prepare_image(cref_policy *p, const float *depth)
{
    float *image = p->work[0];
    int known = 0;
    for (int i = 0; i < PIXELS; i++) {
        known += is_known(depth[i]);
        image[i] = is_known(depth[i]) && depth[i] < CREF_D_MAX ? depth[i] : CREF_D_MAX;
    }
    if (1.0 - (double)known / PIXELS > CREF_MAX_INVALID)
        return CREF_INVALID_DEPTH;
    const unsigned status = look_through(p, depth, image);
    if (status)
        return status;
    for (int i = 0; i < PIXELS; i++)
        image[i] /= CREF_D_MAX;
    fill_holes(depth, image, p->work[1]);
#if CREF_WINDOW > 1
    for (int r = 0; r < CREF_ROWS; r++)
        find_nearest(image + r * CREF_COLUMNS, CREF_COLUMNS, 1, p->work[1] + r * CREF_COLUMNS);
    for (int c = 0; c < CREF_COLUMNS; c++)
        find_nearest(p->work[1] + c, CREF_ROWS, CREF_COLUMNS, image + c);
#endif
    for (int i = 0; i < PIXELS; i++)
        image[i] = round_to_half(image[i]);
    return CREF_OK;
}

unsigned cref_on_depth(cref_policy *p, const float depth[CREF_ROWS * CREF_COLUMNS], double stamp)
{
    p->frame_status = isfinite(stamp) ? prepare_image(p, depth) : CREF_BAD_DEPTH;
    if (!p->frame_status) {
        encode(p);
        p->stamp = stamp;
    }
    return p->frame_status;
}

#endif
