
/* ---------------------------------------------------------------- the network, in float32 */

struct dense { /* x W + b */
    int inputs, outputs;
    const float *kernel; /* W, row by row [inputs][outputs] */
    const float *bias;   /* [outputs], or NULL */
};

struct norm { /* layer normalisation */
    const float *scale, *bias;
};

struct convolution {
    int kernel, stride;
    const struct dense *filter; /* of a patch [kernel][kernel][channels], row by row */
};

/* Defined at the end of this file. */
static const struct dense velocity_estimator_lstm_input, velocity_estimator_lstm_recurrent;
static const struct dense velocity_estimator_velocity;
static const struct dense proprioceptive_tokenizer_layer_0, proprioceptive_tokenizer_layer_1;
static const struct norm fusion_norm;
static const struct dense fusion_mix;
#if CREF_GATED
static const struct dense fusion_content_gate;
#else
static const struct dense fusion_content;
#endif
static const struct dense recurrent_fusion_gru_input, recurrent_fusion_gru_recurrent;
static const float recurrent_fusion_gru_candidate_bias[CREF_GRU];
static const struct dense recurrent_fusion_memory_out;
#if CREF_HIGHWAY
static const struct dense recurrent_fusion_gate;
#endif
static const struct dense *const action_head[CREF_HEAD_LAYERS];
#if CREF_SEES
static const struct convolution convolutions[CREF_CONVOLUTIONS];
static const struct dense depth_tokenizer_projection;
static const float depth_tokenizer_place[CREF_TOKENS * CREF_TOKEN];
static const struct norm depth_tokenizer_norm;
static const struct dense depth_compression_layer_0;
#endif
#if CREF_SEES && CREF_HEADS
static const struct norm cross_attention_norm;
static const struct dense cross_attention_query, cross_attention_output;
static const float cross_attention_key[CREF_TOKEN * CREF_TOKEN];   /* [token][head][each] */
static const float cross_attention_value[CREF_TOKEN * CREF_TOKEN]; /* [token][head][each] */
#elif CREF_SEES
static const struct dense pooled_tokens_projection;
#endif

enum { LANES = 16 }; /* outputs summed at a time, which compilers turn into vector instructions */

static void apply_dense(const struct dense *layer, const float *x, float *out)
{
    const int inputs = layer->inputs, outputs = layer->outputs;
    int first = 0;
    for (; first + LANES <= outputs; first += LANES) {
        const float *kernel = layer->kernel + first;
        float sums[LANES] = {0.0f};
        for (int i = 0; i < inputs; i++, kernel += outputs)
            for (int k = 0; k < LANES; k++)
                sums[k] += x[i] * kernel[k];
        for (int k = 0; k < LANES; k++)
            out[first + k] = sums[k] + (layer->bias ? layer->bias[first + k] : 0.0f);
    }
    for (; first < outputs; first++) {
        float sum = 0.0f;
        for (int i = 0; i < inputs; i++)
            sum += x[i] * layer->kernel[i * outputs + first];
        out[first] = sum + (layer->bias ? layer->bias[first] : 0.0f);
    }
}

static void apply_elu(float *x, int size)
{
    for (int i = 0; i < size; i++)
        if (!(x[i] > 0.0f))
            x[i] = expm1f(x[i]);
}

static void apply_norm(const struct norm *norm, const float *x, int size, float *out)
{
    float mean = 0.0f, variance = 0.0f;
    for (int i = 0; i < size; i++)
        mean += x[i];
    mean /= (float)size;
    for (int i = 0; i < size; i++)
        variance += (x[i] - mean) * (x[i] - mean);
    variance /= (float)size;
    const float root = sqrtf(variance + 1e-6f);
    for (int i = 0; i < size; i++)
        out[i] = (x[i] - mean) * (norm->scale[i] / root) + norm->bias[i];
}

static float sigmoid(float x)
{
    return 1.0f / (1.0f + expf(fminf(-x, 80.0f))); /* more would overflow, and is 0 either way */
}

#if CREF_SEES
/* Filter an image [rows][columns][channels]; the result is stride times smaller. */
static void convolve(const struct convolution *layer, const float *image, int rows, int columns,
                     int channels, float *out)
{
    const int kernel = layer->kernel, stride = layer->stride, outputs = layer->filter->outputs;
    const int before = kernel > stride ? (kernel - stride) / 2 : 0; /* zeros around the image */
    float patch[CREF_PATCH];
    for (int r = 0; r < rows / stride; r++) {
        for (int c = 0; c < columns / stride; c++, out += outputs) {
            float *pixel = patch;
            for (int y = r * stride - before; y < r * stride - before + kernel; y++) {
                for (int x = c * stride - before; x < c * stride - before + kernel; x++) {
                    const bool inside = y >= 0 && y < rows && x >= 0 && x < columns;
                    for (int k = 0; k < channels; k++)
                        *pixel++ = inside ? image[(y * columns + x) * channels + k] : 0.0f;
                }
            }
            apply_dense(layer->filter, patch, out);
            apply_elu(out, outputs);
        }
    }
}

/* Compute the depth tokens and the compressed depth of the image in work[0] (Eq. 6-8). */
static void encode(cref_policy *p)
{
    const float *image = p->work[0];
    float means[CREF_ROWS / 8 * (CREF_COLUMNS / 8)] = {0.0f};
    for (int r = 0; r < CREF_ROWS; r++)
        for (int c = 0; c < CREF_COLUMNS; c++)
            means[r / 8 * (CREF_COLUMNS / 8) + c / 8] += image[r * CREF_COLUMNS + c] / 64.0f;
    apply_dense(&depth_compression_layer_0, means, p->compressed);
    apply_elu(p->compressed, CREF_COMPRESSED);

    int rows = CREF_ROWS, columns = CREF_COLUMNS, channels = 1, at = 0;
    for (int i = 0; i < CREF_CONVOLUTIONS; i++, at = 1 - at) {
        convolve(&convolutions[i], p->work[at], rows, columns, channels, p->work[1 - at]);
        rows /= convolutions[i].stride;
        columns /= convolutions[i].stride;
        channels = convolutions[i].filter->outputs;
    }
    for (int n = 0; n < CREF_TOKENS; n++) {
        float x[CREF_TOKEN];
        apply_dense(&depth_tokenizer_projection, p->work[at] + n * channels, x);
        for (int i = 0; i < CREF_TOKEN; i++)
            x[i] += depth_tokenizer_place[n * CREF_TOKEN + i];
        apply_norm(&depth_tokenizer_norm, x, CREF_TOKEN, p->tokens + n * CREF_TOKEN);
    }
    p->encoded = true;
}
#endif

#if CREF_SEES && CREF_HEADS
static void apply_softmax(float *x, int size)
{
    float largest = x[0], sum = 0.0f;
    for (int i = 1; i < size; i++)
        largest = fmaxf(largest, x[i]);
    for (int i = 0; i < size; i++) {
        x[i] = expf(x[i] - largest);
        sum += x[i];
    }
    for (int i = 0; i < size; i++)
        x[i] /= sum;
}

/* Compute the depth token: the robot's state queries the frame's tokens (Eq. 8-10). */
static void look(const float *tokens, const float *state, float *out)
{
    enum { EACH = CREF_TOKEN / CREF_HEADS };
    float normed[CREF_TOKEN], query[CREF_TOKEN], values[CREF_TOKEN];
    apply_norm(&cross_attention_norm, state, CREF_TOKEN, normed);
    apply_dense(&cross_attention_query, normed, query);
    for (int head = 0; head < CREF_HEADS; head++) {
        const int of_head = head * EACH;
        float query_key[CREF_TOKEN], weights[CREF_TOKENS], mixed[CREF_TOKEN] = {0.0f};
        for (int i = 0; i < CREF_TOKEN; i++) {
            query_key[i] = 0.0f;
            for (int k = 0; k < EACH; k++)
                query_key[i] += query[of_head + k] * cross_attention_key[i * CREF_TOKEN + of_head + k];
        }
        for (int n = 0; n < CREF_TOKENS; n++) {
            weights[n] = 0.0f;
            for (int i = 0; i < CREF_TOKEN; i++)
                weights[n] += query_key[i] * tokens[n * CREF_TOKEN + i];
            weights[n] /= sqrtf((float)EACH);
        }
        apply_softmax(weights, CREF_TOKENS);
        for (int n = 0; n < CREF_TOKENS; n++)
            for (int i = 0; i < CREF_TOKEN; i++)
                mixed[i] += weights[n] * tokens[n * CREF_TOKEN + i];
        for (int k = 0; k < EACH; k++) {
            values[of_head + k] = 0.0f;
            for (int i = 0; i < CREF_TOKEN; i++)
                values[of_head + k] += mixed[i] * cross_attention_value[i * CREF_TOKEN + of_head + k];
        }
    }
    apply_dense(&cross_attention_output, values, out);
}
#elif CREF_SEES
/* Compute the depth token without cross attention: the mean of the frame's tokens. */
static void look(const float *tokens, const float *state, float *out)
{
    float mean[CREF_TOKEN] = {0.0f};
    (void)state;
    for (int n = 0; n < CREF_TOKENS; n++)
        for (int i = 0; i < CREF_TOKEN; i++)
            mean[i] += tokens[n * CREF_TOKEN + i] / (float)CREF_TOKENS;
    apply_dense(&pooled_tokens_projection, mean, out);
}
#endif

/* Estimate the base's velocity by an LSTM (Eq. 7); gates: input, forget, candidate, output. */
static void estimate_velocity(cref_policy *p, const float *inputs)
{
    float gates[4 * CREF_LSTM], of_inputs[4 * CREF_LSTM];
    apply_dense(&velocity_estimator_lstm_recurrent, p->lstm_h, gates);
    apply_dense(&velocity_estimator_lstm_input, inputs, of_inputs);
    for (int i = 0; i < 4 * CREF_LSTM; i++)
        gates[i] += of_inputs[i];
    for (int i = 0; i < CREF_LSTM; i++) {
        const float *gate = gates + i;
        p->lstm_c[i] *= sigmoid(gate[CREF_LSTM]);
        p->lstm_c[i] += sigmoid(gate[0]) * tanhf(gate[2 * CREF_LSTM]);
        p->lstm_h[i] = tanhf(p->lstm_c[i]) * sigmoid(gate[3 * CREF_LSTM]);
    }
    apply_dense(&velocity_estimator_velocity, p->lstm_h, p->velocity);
}

/* Add to x what a gate lets through of a mixture of x (Eq. 11-14). */
static void fuse(float x[CREF_FUSED])
{
    float normed[CREF_FUSED], mixed[CREF_FUSED];
    apply_norm(&fusion_norm, x, CREF_FUSED, normed);
    apply_dense(&fusion_mix, normed, mixed);
    apply_elu(mixed, CREF_FUSED);
#if CREF_GATED
    float content[2 * CREF_FUSED]; /* and its gate */
    apply_dense(&fusion_content_gate, mixed, content);
    for (int i = 0; i < CREF_FUSED; i++)
        x[i] += content[i] * sigmoid(content[CREF_FUSED + i]);
#else
    float content[CREF_FUSED];
    apply_dense(&fusion_content, mixed, content);
    for (int i = 0; i < CREF_FUSED; i++)
        x[i] += content[i];
#endif
}

/* Update the GRU (Eq. 15) with x and blend its output into x; gates: reset, update, candidate. */
static void remember(cref_policy *p, float x[CREF_FUSED])
{
    float gates[3 * CREF_GRU], of_x[3 * CREF_GRU], memory[CREF_FUSED];
    apply_dense(&recurrent_fusion_gru_recurrent, p->gru, gates);
    apply_dense(&recurrent_fusion_gru_input, x, of_x);
    for (int i = 0; i < CREF_GRU; i++) {
        const float reset = sigmoid(gates[i] + of_x[i]);
        const float update = sigmoid(gates[CREF_GRU + i] + of_x[CREF_GRU + i]);
        const float recurrent = gates[2 * CREF_GRU + i] + recurrent_fusion_gru_candidate_bias[i];
        const float candidate = tanhf(recurrent * reset + of_x[2 * CREF_GRU + i]);
        p->gru[i] = (p->gru[i] - candidate) * update + candidate;
    }
    apply_dense(&recurrent_fusion_memory_out, p->gru, memory);
#if CREF_HIGHWAY
    float both[2 * CREF_FUSED], gate[CREF_FUSED]; /* Eq. 16 */
    memcpy(both, memory, sizeof memory);
    memcpy(both + CREF_FUSED, x, CREF_FUSED * sizeof *x);
    apply_dense(&recurrent_fusion_gate, both, gate);
    for (int i = 0; i < CREF_FUSED; i++)
        x[i] += (memory[i] - x[i]) * sigmoid(gate[i]);
#else
    memcpy(x, memory, sizeof memory);
#endif
}

/* Compute the action of a normalised observation, and update the memory. */
static void run_network(cref_policy *p, const float obs[CREF_OBSERVATION],
                        float action[CREF_JOINTS])
{
    float known[CREF_OBSERVATION + 3], hidden[CREF_TOKEN], x[CREF_FUSED] = {0.0f};
#if CREF_SEES
    float inputs[CREF_OBSERVATION + CREF_COMPRESSED];
    memcpy(inputs, obs, CREF_OBSERVATION * sizeof *obs);
    memcpy(inputs + CREF_OBSERVATION, p->compressed, sizeof p->compressed);
    estimate_velocity(p, inputs);
#else
    estimate_velocity(p, obs);
#endif
    memcpy(known, obs, CREF_OBSERVATION * sizeof *obs);
    memcpy(known + CREF_OBSERVATION, p->velocity, sizeof p->velocity);
    apply_dense(&proprioceptive_tokenizer_layer_0, known, hidden);
    apply_elu(hidden, CREF_TOKEN);
    apply_dense(&proprioceptive_tokenizer_layer_1, hidden, x);
#if CREF_SEES
    if (p->encoded)
        look(p->tokens, x, x + CREF_TOKEN);
#endif
    fuse(x);
    remember(p, x);

    float layers[2][CREF_WIDEST];
    const float *input = x;
    for (int i = 0; i < CREF_HEAD_LAYERS - 1; i++) {
        apply_dense(action_head[i], input, layers[i % 2]);
        apply_elu(layers[i % 2], action_head[i]->outputs);
        input = layers[i % 2];
    }
    apply_dense(action_head[CREF_HEAD_LAYERS - 1], input, action);
}
