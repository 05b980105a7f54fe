/* Points, landmarks and clouds of bulk messages, in both directions. */
#ifndef IGTL_GATEWAY_KERNEL_POINTS_H
#define IGTL_GATEWAY_KERNEL_POINTS_H

#include "_loops.h"

/* Positions of a PointCloud2. */
struct points {
    const uint8_t *first;
    ssize_t step, x, y, z; /* bytes from one point to the next, and to the coordinates */
    float times, by;
};

/* First bytes of name, group and owner.  If one is not 0, a list with labels is published, too. */
static uint32_t labels_of(const uint8_t *one) { return one[0] | one[GROUP_AT] | one[OWNER_AT]; }

static uint32_t place_to_igtl(const struct points *points, const uint8_t *one, uint8_t *row)
{
    uint32_t x = word_of(scaled(get_u32_ros(one + points->x), points->times, points->by));
    uint32_t y = word_of(scaled(get_u32_ros(one + points->y), points->times, points->by));
    uint32_t z = word_of(scaled(get_u32_ros(one + points->z), points->times, points->by));
    put_u32(row, x);
    put_u32(row + 4, y);
    put_u32(row + 8, z);
    return not_finite(x) | not_finite(y) | not_finite(z);
}

#if defined(__x86_64__)
/* Convert positions of which x, y and z follow one another in points of at least 16 bytes. */
WITH_AVX2 static uint32_t wide_places_to_igtl(const struct points *points, ssize_t begin, ssize_t count, uint8_t *row)
{
    const __m128i swap = _mm_set_epi8(12, 13, 14, 15, 8, 9, 10, 11, 4, 5, 6, 7, 0, 1, 2, 3);
    const __m128i exponent = _mm_set1_epi32(0x7F800000);
    const __m128i place = _mm_set_epi32(0, -1, -1, -1); /* the fourth word can be anything, numbers that are slow too */
    const __m128 times = _mm_set1_ps(points->times), by = _mm_set1_ps(points->by);
    const uint8_t *one = points->first + begin * points->step;
    __m128i odd = _mm_setzero_si128();
    ssize_t i = 0;
    for (; i + 1 < count; i++, one += points->step, row += 12) { /* each writes 4 bytes into the next row */
        __m128i words = _mm_and_si128(_mm_loadu_si128((const __m128i *)(const void *)(one + points->x)), place);
        words = _mm_castps_si128(_mm_div_ps(_mm_mul_ps(_mm_castsi128_ps(words), times), by));
        odd = _mm_or_si128(odd, _mm_cmpeq_epi32(_mm_and_si128(words, exponent), exponent));
        _mm_storeu_si128((__m128i *)(void *)row, _mm_shuffle_epi8(words, swap));
    }
    uint32_t last = i < count ? place_to_igtl(points, one, row) : 0;
    return last | (uint32_t)_mm_movemask_epi8(odd);
}

/* Write whole points with positions of which x, y and z follow one another; 16 bytes of each are read. */
WITH_AVX2 static uint32_t wide_points_to_igtl(const struct points *points, ssize_t begin, ssize_t count, uint8_t *row)
{
    const __m128i swap = _mm_set_epi8(12, 13, 14, 15, 8, 9, 10, 11, 4, 5, 6, 7, 0, 1, 2, 3);
    const __m128i exponent = _mm_set1_epi32(0x7F800000), white = _mm_set_epi32(0, 0, 0, (int)WHITE);
    const __m128i place = _mm_set_epi32(0, -1, -1, -1), none = _mm_setzero_si128();
    const __m128 times = _mm_set1_ps(points->times), by = _mm_set1_ps(points->by);
    const uint8_t *one = points->first + begin * points->step + points->x;
    __m128i odd_words = none;
    for (ssize_t i = 0; i < count; i++, one += points->step, row += POINT_BYTES) {
        __m128i words = _mm_and_si128(_mm_loadu_si128((const __m128i *)(const void *)one), place);
        words = _mm_castps_si128(_mm_div_ps(_mm_mul_ps(_mm_castsi128_ps(words), times), by));
        odd_words = _mm_or_si128(odd_words, _mm_cmpeq_epi32(_mm_and_si128(words, exponent), exponent));
        words = _mm_or_si128(_mm_shuffle_epi8(_mm_slli_si128(words, 4), swap), white);
        for (int at = 0; at < RGBA_AT; at += 32)
            _mm256_storeu_si256((__m256i *)(void *)(row + at), _mm256_setzero_si256());
        _mm_storeu_si128((__m128i *)(void *)(row + RGBA_AT), words);
        _mm_storeu_si128((__m128i *)(void *)(row + RGBA_AT + 16), none);
        _mm_storel_epi64((__m128i *)(void *)(row + POINT_BYTES - 8), none);
    }
    return (uint32_t)_mm_movemask_epi8(odd_words);
}

/* Read points without labels (``labels``: all bits; 0: with the labels of the sample): positions, colours and diameters. */
WITH_AVX2 static uint32_t wide_points_to_ros(uint8_t *row, const uint8_t *one, ssize_t count, float times, float by,
                                             uint32_t labels)
{
    const __m128i swap = _mm_set_epi8(12, 13, 14, 15, 8, 9, 10, 11, 4, 5, 6, 7, 0, 1, 2, 3);
    const __m128i colour = _mm_set_epi8(15, 12, 13, 14, 8, 9, 10, 11, 4, 5, 6, 7, 0, 1, 2, 3); /* BGRA of RGBA */
    const __m128i exponent = _mm_set1_epi32(0x7F800000), place = _mm_set_epi32(0, -1, -1, -1);
    const __m128 wide_times = _mm_set1_ps(times), wide_by = _mm_set1_ps(by);
    __m128i odd_words = _mm_setzero_si128();
    uint32_t odd = 0;
    for (; count > 0; count--, one += POINT_BYTES, row += ROW_OF_POINTS) {
        __m128i bytes = _mm_loadu_si128((const __m128i *)(const void *)(one + RGBA_AT)); /* rgba, x, y, z */
        __m128i turned = _mm_shuffle_epi32(bytes, _MM_SHUFFLE(0, 3, 2, 1));
        __m128i words = _mm_and_si128(_mm_shuffle_epi8(turned, swap), place);
        words = _mm_castps_si128(_mm_div_ps(_mm_mul_ps(_mm_castsi128_ps(words), wide_times), wide_by));
        odd_words = _mm_or_si128(odd_words, _mm_cmpeq_epi32(_mm_and_si128(words, exponent), exponent));
        words = _mm_or_si128(words, _mm_andnot_si128(place, _mm_shuffle_epi8(turned, colour)));
        _mm_storeu_si128((__m128i *)(void *)row, words);
        uint32_t diameter = word_of(scaled(get_u32(one + POSITION_AT + 12), times, by));
        odd |= not_finite(diameter) | (labels & labels_of(one));
        put_u32_ros(row + 16, diameter);
    }
    return odd | (uint32_t)_mm_movemask_epi8(odd_words);
}
#endif

/* Convert ``count`` positions from the one numbered ``begin`` to rows of ``row_size`` bytes. */
static uint32_t places_to_igtl(const struct points *points, ssize_t begin, ssize_t count, uint8_t *row, ssize_t row_size)
{
    const uint8_t *one = points->first + begin * points->step;
    int joined = points->y == points->x + 4 && points->z == points->x + 8;
    if (joined && points->step == 12 && row_size == 12)
        return floats_to_igtl(one, row, 3 * count, points->times, points->by);
#if defined(__x86_64__)
    if (has_avx2 && joined && points->step >= points->x + 16 && row_size == 12)
        return wide_places_to_igtl(points, begin, count, row);
#endif
    uint32_t odd = 0;
    for (; count > 0; count--, one += points->step, row += row_size)
        odd |= place_to_igtl(points, one, row);
    return odd;
}

/* Write whole points without labels, white and of no size. */
static uint32_t points_to_igtl(const struct points *points, ssize_t begin, ssize_t count, uint8_t *row)
{
    uint32_t odd = 0;
#if defined(__x86_64__)
    if (has_avx2 && points->y == points->x + 4 && points->z == points->x + 8 && points->step >= points->x + 12) {
        ssize_t most = count - 1; /* the message may end with the 12 bytes of the last one */
        odd = wide_points_to_igtl(points, begin, most, row);
        begin += most, count -= most, row += most * POINT_BYTES;
    }
#endif
    memset(row, 0, (size_t)(POINT_BYTES * count));
    for (ssize_t i = 0; i < count; i++)
        put_u32(row + POINT_BYTES * i + RGBA_AT, WHITE);
    return odd | places_to_igtl(points, begin, count, row + POSITION_AT, POINT_BYTES);
}

/* The landmarks of the sample of a stream. */
static const uint8_t *landmarks_of(const struct igtl_bulk *stream) { return stream->sample + stream->at + stream->tail; }

/* Whether points have the labels and colours of those in the sample; their places and diameters may be others. */
static int has_labels(const struct igtl_bulk *stream, const uint8_t *content, ssize_t size)
{
    if (size != stream->landmarks)
        return 0;
    for (ssize_t at = 0; at < size; at += POINT_BYTES)
        if (!equal(content + at, landmarks_of(stream) + at, 0, POSITION_AT) ||
            !equal(content + at, landmarks_of(stream) + at, OWNER_AT, POINT_BYTES))
            return 0;
    return 1;
}

/* Set the number of points of POLYDATA; 0: not only points. */
static int count_cloud(const uint8_t *content, ssize_t size, ssize_t *count)
{
    if (size < POLYDATA_HEAD)
        return 0;
    uint64_t points = get_u32(content), cells = get_u32(content + 4), cells_size = get_u32(content + 8);
    for (int word = 3; word < 10; word++) /* lines, polygons, strips, attributes */
        if (get_u32(content + 4 * word))
            return 0;
    if (!points || (uint64_t)size != POLYDATA_HEAD + 12 * points + cells_size)
        return 0;
    if (cells ? cells != 1 || cells_size != 4 * (points + 1) || get_u32(content + POLYDATA_HEAD + 12 * points) != points
              : cells_size != 0)
        return 0;
    *count = (ssize_t)points;
    return 1;
}

/* Whether the rows of landmarks are within the template, and one of them at least. */
static int has_landmark_rows(const struct ros_form *form)
{
    ssize_t size = form->room - form->rest;
    if (size < 12 || form->rest < LANDMARK_TO_ROS || form->rest % LANDMARK_TO_ROS || form->stamp_at > size - 8)
        return 0;
    for (ssize_t at = size; at < form->room; at += LANDMARK_TO_ROS)
        if ((ssize_t)get_u32_ros(form->template + at) > size - LANDMARK_BYTES)
            return 0;
    return 1;
}

static uint32_t put_point(uint8_t *out, const uint8_t *content, double times, double by, uint32_t labels)
{
    double place[3];
    for (int axis = 0; axis < 3; axis++) {
        double value = get_f32(content + POSITION_AT + 4 * axis);
        if (!isfinite(value))
            return 1;
        place[axis] = value * times / by;
    }
    memcpy(out, place, sizeof place);
    return labels & labels_of(content);
}

static uint32_t put_points(uint8_t *row, const uint8_t *one, ssize_t count, float times, float by, uint32_t labels)
{
#if defined(__x86_64__)
    if (has_avx2)
        return wide_points_to_ros(row, one, count, times, by, labels);
#endif
    uint32_t odd = 0;
    for (; count > 0; count--, one += POINT_BYTES, row += ROW_OF_POINTS) {
        for (int axis = 0; axis < 3; axis++) {
            uint32_t word = word_of(scaled(get_u32(one + POSITION_AT + 4 * axis), times, by));
            odd |= not_finite(word);
            put_u32_ros(row + 4 * axis, word);
        }
        uint32_t rgba = get_u32(one + RGBA_AT), diameter = word_of(scaled(get_u32(one + POSITION_AT + 12), times, by));
        odd |= not_finite(diameter) | (labels & labels_of(one));
        put_u32_ros(row + 12, rgba << 24 | rgba >> 8);
        put_u32_ros(row + 16, diameter);
    }
    return odd;
}

/* Write places and diameters of landmarks, each four numbers; not 0: the message needs the full path. */
static uint32_t put_landmarks(const struct ros_form *form, const struct igtl_bulk *stream, const uint8_t *content)
{
    const uint8_t *row = form->template + form->room - form->rest;
    uint32_t odd = 0;
    for (ssize_t i = 0; i < form->count; i++)
        odd |= floats_to_doubles(content + POINT_BYTES * i + POSITION_AT, form->out + get_u32_ros(row + LANDMARK_TO_ROS * i),
                                 4, stream->times, stream->by);
    return odd;
}

/* Find the points of a cloud; 0: the message needs the full path. */
static int find_cloud(const struct ros_bulk *stream, const uint8_t *cdr, ssize_t size, struct found *found)
{
    if (size < stream->data_at + 1)
        return 0;
    uint64_t height = get_u32_ros(cdr + stream->height_at), width = get_u32_ros(cdr + stream->height_at + 4);
    uint64_t row = get_u32_ros(cdr + stream->data_at - 8), length = get_u32_ros(cdr + stream->data_at - 4);
    uint64_t step = (uint64_t)stream->step;
    if (length + 1 > (uint64_t)(size - stream->data_at) || (height != 1 && row != width * step))
        return 0;
    if (!height || !width || height > length || width > length || height * width > length / step)
        return 0;
    found->count = (ssize_t)(height * width);
    found->size = POINT_BYTES * found->count;
    if (stream->form == CLOUD)
        found->size = POLYDATA_HEAD + 12 * found->count + 4 * (found->count + 1);
    return 1;
}

#endif
