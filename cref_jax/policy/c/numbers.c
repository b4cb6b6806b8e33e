
/* ---------------------------------------------------------------- numbers */

static bool are_finite(const float *x, int size)
{
    for (int i = 0; i < size; i++)
        if (!isfinite(x[i]))
            return false;
    return true;
}

static float clip(float x, float low, float high)
{
    return fminf(fmaxf(x, low), high);
}

static float find_largest(const float *x, int size)
{
    float largest = 0.0f;
    for (int i = 0; i < size; i++)
        largest = fmaxf(largest, fabsf(x[i]));
    return largest;
}

/* Compute the largest difference of two poses, rad. */
static float compare_poses(const float *a, const float *b)
{
    float largest = 0.0f;
    for (int j = 0; j < CREF_JOINTS; j++)
        largest = fmaxf(largest, fabsf(a[j] - b[j]));
    return largest;
}
