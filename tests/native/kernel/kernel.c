/* Tests of igtl_gateway/native/kernel, without Python: tests/native/test_kernel.py and `make sanitize` compile and run them.
 *
 *     kernel [ROUNDS [SEED]]       rounds of foreign bytes for each function that reads lengths
 *
 * Each buffer is an allocation of its own that ends with its last byte, so the address sanitizer finds a read beyond it.
 */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>

#include "_bulk_to_igtl.h"
#include "_bulk_to_ros.h"
#include "_queue.h"
#include "_records.h"

static int failures;

#define CHECK(condition)                                                                                               \
    do {                                                                                                               \
        if (!(condition)) {                                                                                            \
            failures++;                                                                                                \
            printf("%s:%d: not so: %s\n", __FILE__, __LINE__, #condition);                                             \
        }                                                                                                              \
    } while (0)

static uint64_t random_state = 1;

static uint32_t any(void)
{
    random_state ^= random_state << 13;
    random_state ^= random_state >> 7;
    random_state ^= random_state << 17;
    return (uint32_t)(random_state >> 16);
}

static uint32_t below(uint32_t bound) { return any() % bound; }

/* Memory of exactly this size with any bytes; its owner frees it. */
static uint8_t *bytes_of(ssize_t size)
{
    uint8_t *bytes = malloc(size ? (size_t)size : 1);
    if (!bytes)
        exit(2);
    for (ssize_t i = 0; i < size; i++)
        bytes[i] = (uint8_t)any();
    return bytes;
}

/* -- CRC and stamps ---------------------------------------------------------------------------------------------------- */

static uint64_t crc_by_bits(const uint8_t *data, ssize_t size)
{
    uint64_t crc = 0;
    for (ssize_t i = 0; i < size; i++) {
        crc ^= (uint64_t)data[i] << 56;
        for (int bit = 0; bit < 8; bit++)
            crc = crc << 1 ^ (crc >> 63 ? CRC64_POLYNOMIAL : 0);
    }
    return crc;
}

static void test_crc(void)
{
    CHECK(crc64((const uint8_t *)"123456789", 9) == 0x6C40DF5F0B497347u); /* the check value of CRC-64/ECMA-182 */
    for (ssize_t size = 0; size < 1200; size += size < 300 ? 1 : 37) {
        uint8_t *data = bytes_of(size);
        uint64_t expected = crc_by_bits(data, size);
        ssize_t cut = (ssize_t)below((uint32_t)size + 1);
        CHECK(crc64(data, size) == expected);
        CHECK(crc64_portable(0, data, size) == expected);
        CHECK(crc64_update(crc64_update(0, data, cut), data + cut, size - cut) == expected);
        free(data);
    }
    for (ssize_t count = 1; count < 40; count++) {
        uint8_t *rows = bytes_of(count * CRC64_ROW_BYTES);
        for (ssize_t i = 0; i < count * CRC64_ROW_BYTES; i++)
            if (i % CRC64_ROW_BYTES < CRC64_WORD_AT || i % CRC64_ROW_BYTES >= CRC64_WORD_AT + 16)
                rows[i] = 0;
        CHECK(crc64_update_rows(7, rows, count) == crc64_portable(7, rows, count * CRC64_ROW_BYTES));
        free(rows);
    }
}

static void test_stamps(void)
{
    for (int i = 0; i < 2000; i++) {
        int64_t ns = (int64_t)any() * NS_PER_S + (int64_t)below(1000000000);
        CHECK(ticks_to_ns(ns_to_ticks(ns)) == ns);
    }
    CHECK(ns_to_ticks(-1) == 0);
}

/* -- poses --------------------------------------------------------------------------------------------------------------- */

static void test_poses(void)
{
    for (int i = 0; i < 2000; i++) {
        double q[4], matrix[12] = {0}, pose[7];
        for (int k = 0; k < 4; k++)
            q[k] = (double)any() / UINT32_MAX - 0.5;
        if (!unit(q, q))
            continue;
        positive(q);
        rotation_matrix(q, matrix);
        CHECK(pose_of_numbers(matrix, MATRIX_BYTES, 1.0, 1000.0, pose));
        for (int k = 0; k < 4; k++)
            CHECK(fabs(pose[3 + k] - q[k]) < 1e-9);
        matrix[0] += 0.1; /* neither a rotation */
        CHECK(!pose_of_numbers(matrix, MATRIX_BYTES, 1.0, 1000.0, pose));
    }
    const double nothing[7] = {0};
    double numbers[12];
    CHECK(!numbers_of_pose((const uint8_t *)nothing, MATRIX_BYTES, 1000.0, 1.0, numbers));
    const double infinite[7] = {INFINITY, 0, 0, 0, 0, 0, 1};
    CHECK(!numbers_of_pose((const uint8_t *)infinite, QUATERNION_BYTES, 1000.0, 1.0, numbers));
}

/* -- both ways ----------------------------------------------------------------------------------------------------------- */

#define HEAD (HEADER_SIZE + 0)

/* Make the OpenIGTLink message of a ROS message; NULL: it needs the full path. */
static uint8_t *to_igtl(const struct ros_bulk *stream, const uint8_t *cdr, ssize_t size, ssize_t *made)
{
    static const uint8_t head[HEAD] = {0, 1, 'P', 'O'}, none[1] = {0};
    struct found found = {0};
    if (!find_in_ros(stream, cdr, size, &found))
        return NULL;
    *made = HEAD + found.size;
    uint8_t *out = bytes_of(*made);
    const struct igtl_form form = {head, none, HEAD, 0, 0, out};
    if (bulk_from_ros(stream, &found, &form, 1, 5 * NS_PER_S))
        return out;
    free(out);
    return NULL;
}

/* Make the ROS message of an OpenIGTLink message; NULL: it needs the full path, or has none. */
static uint8_t *to_ros(struct ros_form *form, const uint8_t *data, ssize_t size)
{
    const struct igtl_bulk stream = {data, HEAD, 0, 1, 1.0, 1.0, 0};
    if (!prepare_form(form, data + HEAD, size - HEAD) || !form->size)
        return NULL;
    form->out = bytes_of(form->size);
    if (bulk_from_igtl_fits(&stream, data, size) && bulk_from_igtl(&stream, data, size, form, 1, 5 * NS_PER_S))
        return form->out;
    free(form->out);
    return NULL;
}

static void put_word(uint8_t *at, ssize_t value) { put_u32_ros(at, (uint32_t)value); }

/* A Mesh with any vertices; its owner frees it. */
static uint8_t *mesh_of(ssize_t triangles, ssize_t vertices, ssize_t *size)
{
    *size = vertices_at(triangles) + 24 * vertices;
    uint8_t *cdr = bytes_of(*size);
    memset(cdr, 0, (size_t)vertices_at(triangles));
    memcpy(cdr, "\0\1\0\0", 4);
    put_word(cdr + 4, triangles);
    for (ssize_t i = 0; i < 3 * triangles; i++)
        put_word(cdr + 8 + 4 * i, below((uint32_t)vertices));
    put_word(cdr + 8 + 12 * triangles, vertices);
    for (ssize_t i = 0; i < 3 * vertices; i++) {
        double value = (double)(int32_t)any() / 1024.0;
        value = (double)(float)value;
        memcpy(cdr + vertices_at(triangles) + 8 * i, &value, 8);
    }
    return cdr;
}

static void test_meshes(void)
{
    const struct ros_bulk stream = {.sample = (const uint8_t *)"\0\1\0\0", .size = 4, .form = MESH, .times = 1, .by = 1};
    for (ssize_t triangles = 1; triangles < 6000; triangles = triangles * 3 + 1) {
        ssize_t size, made = 0;
        uint8_t *cdr = mesh_of(triangles, triangles + 2, &size), *data = to_igtl(&stream, cdr, size, &made);
        struct ros_form form = {.form = MESH, .template = (const uint8_t *)""};
        uint8_t *again = data ? to_ros(&form, data, made) : NULL;
        CHECK(again && form.size == size && !memcmp(again, cdr, (size_t)size));
        if (data) { /* one index beyond the vertices, with the right CRC */
            put_u32(data + made - 4, (uint32_t)triangles + 2);
            put_u64(data + CRC_AT, crc64(data + HEADER_SIZE, made - HEADER_SIZE));
            CHECK(!to_ros(&form, data, made));
        }
        put_word(cdr + 8, triangles + 2);
        CHECK(!to_igtl(&stream, cdr, size, &made));
        free(cdr), free(data), free(again);
    }
}

static void test_pictures(void)
{
    for (ssize_t size = 0; size < 400; size += 3) {
        uint8_t *from = bytes_of(size), *once = bytes_of(size), *twice = bytes_of(size);
        put_blue_first(from, once, size);
        put_blue_first(once, twice, size);
        CHECK(!memcmp(from, twice, (size_t)size));
        CHECK(!size || (once[0] == from[2] && once[size - 1] == from[size - 3]));
        free(from), free(once), free(twice);
    }
}

/* A string in ASCII there and back. */
static void test_texts(void)
{
    const struct ros_bulk stream = {.sample = (const uint8_t *)"\0\1\0\0", .size = 4, .form = TEXT};
    for (ssize_t length = 0; length < 300; length++) {
        ssize_t size = 8 + length + 1, made = 0;
        uint8_t *cdr = bytes_of(size);
        memcpy(cdr, "\0\1\0\0", 4);
        put_word(cdr + 4, length + 1);
        memset(cdr + 8, 'a', (size_t)length);
        cdr[8 + length] = 0;
        uint8_t *data = to_igtl(&stream, cdr, size, &made);
        struct ros_form form = {.form = TEXT, .template = (const uint8_t *)""};
        uint8_t *again = data ? to_ros(&form, data, made) : NULL;
        CHECK(again && form.size == size && !memcmp(again, cdr, (size_t)size));
        if (length) {
            cdr[8 + below((uint32_t)length)] = 0xE4; /* not ASCII */
            CHECK(!to_igtl(&stream, cdr, size, &made));
        }
        free(cdr), free(data), free(again);
    }
}

/* A Marker of triangles from the bytes of its pose on: points, no colours, and empty strings and sequences behind them. */
enum { POSE_AT = 12, COUNT_AT = 96, PLACES_AT = 100 };

static uint8_t *marker_of(ssize_t points, ssize_t *size)
{
    *size = PLACES_AT + 24 * points + 48;
    uint8_t *cdr = bytes_of(*size);
    memset(cdr, 0, (size_t)*size);
    memcpy(cdr, "\0\1\0\0", 4);
    put_word(cdr + COUNT_AT, points);
    for (ssize_t i = 0; i < 3 * points; i++) {
        double value = (double)(int32_t)any() / 1024.0;
        memcpy(cdr + PLACES_AT + 8 * i, &value, 8);
    }
    return cdr;
}

static void test_markers(void)
{
    uint8_t sample[PLACES_AT] = {0, 1};
    const double scale[3] = {1, 1, 1};
    memcpy(sample + POSE_AT + 56, scale, sizeof scale);
    for (ssize_t points = 3; points < 3000; points *= 4) {
        struct ros_bulk stream = {.sample = sample, .size = PLACES_AT, .form = TRIANGLES, .times = 1, .by = 1};
        const ssize_t numbers[8] = {POSE_AT, PLACES_AT, 12, PLACES_AT - COUNT_AT, 4, 8, 0, 4};
        ssize_t size, made = 0;
        uint8_t *cdr = marker_of(points, &size), *data = NULL;
        CHECK(set_places(&stream, numbers, 8));
        CHECK(points % 3 || (data = to_igtl(&stream, cdr, size, &made)));
        CHECK(!data || (get_u32(data + HEAD) == (uint32_t)points && get_u32(data + HEAD + 20) == (uint32_t)points / 3));
        free(data);
        for (ssize_t at = PLACES_AT + 24 * points; at + 4 <= size; at += 4) { /* a length that reaches beyond the message */
            uint32_t before = get_u32_ros(cdr + at);
            put_u32_ros(cdr + at, below(2) ? UINT32_MAX : (uint32_t)(size - at));
            free(to_igtl(&stream, cdr, size, &made));
            put_u32_ros(cdr + at, before);
        }
        uint8_t *cut = bytes_of(size - 5);
        memcpy(cut, cdr, (size_t)size - 5);
        for (ssize_t less = size - 5; less > PLACES_AT; less -= 1 + (ssize_t)below(40))
            free(to_igtl(&stream, cut, less, &made));
        free(cut), free(cdr);
    }
}

/* Clouds of points of 12 and of 20 bytes, as POLYDATA and as POINT. */
static void test_clouds(void)
{
    enum { HEIGHT_AT = 12, DATA_AT = 48 };
    uint8_t sample[DATA_AT] = {0, 1}, template[64];
    for (ssize_t step = 12; step <= 20; step += 8)
        for (ssize_t count = 1; count < 2000; count = count * 3 + 1) {
            ssize_t size = DATA_AT + step * count + 1, made = 0;
            uint8_t *cdr = bytes_of(size);
            memset(cdr, 0, DATA_AT);
            cdr[1] = 1;
            put_word(cdr + HEIGHT_AT, 1), put_word(cdr + HEIGHT_AT + 4, count);
            put_word(cdr + DATA_AT - 8, step * count), put_word(cdr + DATA_AT - 4, step * count);
            for (ssize_t i = 0; i < step * count; i += 4)
                put_u32_ros(cdr + DATA_AT + i, word_of((float)(int32_t)any() / 1024.0f));
            for (int form = POINTS; form <= CLOUD; form++) {
                struct ros_bulk stream = {.sample = sample, .size = DATA_AT, .form = form, .times = 1, .by = 1};
                const ssize_t numbers[8] = {HEIGHT_AT, DATA_AT, step, 0, 4, 8, 0, 4};
                CHECK(set_places(&stream, numbers, 8));
                uint8_t *data = to_igtl(&stream, cdr, size, &made);
                CHECK(data != NULL);
                memset(template, 0, sizeof template);
                struct ros_form back = {.form = form, .template = template, .room = 64, .stamp_at = 4, .width_at = 16};
                CHECK(has_room(&back));
                uint8_t *again = data ? to_ros(&back, data, made) : NULL;
                CHECK(again && back.count == count);
                ssize_t row = form == CLOUD ? ROW_OF_CLOUD : ROW_OF_POINTS;
                for (ssize_t i = 0; again && i < count; i++)
                    CHECK(!memcmp(again + 64 + row * i, cdr + DATA_AT + step * i, 12));
                free(data), free(again);
            }
            put_word(cdr + HEIGHT_AT + 4, count + 1); /* more points than there are bytes */
            struct ros_bulk stream = {.sample = sample, .size = DATA_AT, .form = CLOUD, .times = 1, .by = 1};
            const ssize_t numbers[8] = {HEIGHT_AT, DATA_AT, step, 0, 4, 8, 0, 4};
            CHECK(set_places(&stream, numbers, 8) && !to_igtl(&stream, cdr, size, &made));
            free(cdr);
        }
}

/* A TRANSFORM into a template and back; what differs from the sample is refused. */
static void test_pose_streams(void)
{
    const ssize_t size = HEADER_SIZE + MATRIX_BYTES;
    uint8_t *sample = bytes_of(size);
    put_u64(sample + BODY_SIZE_AT, MATRIX_BYTES);
    const struct igtl_poses stream = {sample, size, HEADER_SIZE, MATRIX_BYTES, 1, 1.0, 1000.0};
    for (int i = 0; i < 500; i++) {
        double given[7] = {1, 2, 3}, numbers[12], pose[7];
        for (int k = 3; k < 7; k++)
            given[k] = (double)any() / UINT32_MAX - 0.5;
        uint8_t *message = bytes_of(size);
        memcpy(message, sample, (size_t)size);
        CHECK(numbers_of_pose((const uint8_t *)given, MATRIX_BYTES, 1000.0, 1.0, numbers));
        put_u64(message + TICKS_AT, any());
        put_igtl_pose(message, size, HEADER_SIZE, MATRIX_BYTES, 0, numbers, 0, 0);
        CHECK(pose_from_igtl(&stream, message, size, pose) && fabs(pose[1] - 2) < 1e-6);
        CHECK(!pose_from_igtl(&stream, message, size - 1, pose));
        message[HEADER_SIZE + (ssize_t)below(MATRIX_BYTES)] ^= 1; /* the CRC */
        CHECK(!pose_from_igtl(&stream, message, size, pose));
        message[below(TICKS_AT)] ^= 1; /* the names */
        CHECK(!pose_from_igtl(&stream, message, size, pose));
        free(message);
    }
    free(sample);
}

/* Tools of tracking data: rows that reach beyond the sample are refused, the others are filled. */
static void test_tools(void)
{
    enum { TOOLS_HERE = 3, WIDTH = TOOL_HEAD + MATRIX_BYTES, SIZE = 300 };
    const ssize_t size = SIZE + TOOLS_HERE * WIDTH + ROW_FROM_ROS * (TOOLS_HERE + 2);
    uint8_t *sample = bytes_of(size), *cdr = bytes_of(SIZE);
    struct ros_bulk stream = {.sample = sample, .size = size, .form = TOOLS, .times = 1, .by = 1};
    const ssize_t numbers[6] = {TOOLS_HERE, SIZE, WIDTH, 0, 0, 0};
    memcpy(cdr, sample, SIZE);
    for (int i = 0; i < TOOLS_HERE + 2; i++) {
        uint8_t *row = sample + SIZE + TOOLS_HERE * WIDTH + ROW_FROM_ROS * i;
        put_word(row, 100), put_word(row + 4, 120);
        put_word(row + 8, 120 + POSE_BYTES * (i % TOOLS_HERE));
    }
    for (int i = 0; i < TOOLS_HERE; i++) {
        const double pose[7] = {1, 2, 3, 0, 0, 0, 1};
        memcpy(cdr + 120 + POSE_BYTES * i, pose, sizeof pose);
    }
    ssize_t made = 0;
    CHECK(set_places(&stream, numbers, 6));
    uint8_t *data = to_igtl(&stream, cdr, SIZE, &made);
    CHECK(data && made == HEAD + TOOLS_HERE * WIDTH);
    free(data);
    cdr[110] ^= 1;
    CHECK(!to_igtl(&stream, cdr, SIZE, &made));
    for (int i = 0; i < 3000; i++) { /* any rows */
        uint8_t *word = sample + SIZE + TOOLS_HERE * WIDTH + (ssize_t)(4 * below(3 * (TOOLS_HERE + 2)));
        put_u32_ros(word, below(3) ? below(SIZE) : any());
        if (set_places(&stream, numbers, 6))
            free(to_igtl(&stream, cdr, SIZE, &made));
    }
    free(sample), free(cdr);
}

static void test_metadata(void)
{
    uint8_t *sizes = bytes_of(EXTENDED_SIZE), *block = bytes_of(30);
    const struct metadata known = {sizes, block, 30}, none = {NULL, NULL, 0};
    for (ssize_t size = HEADER_SIZE; size < HEADER_SIZE + EXTENDED_SIZE + 60; size++) {
        uint8_t *message = bytes_of(size);
        int has_room = size >= HEADER_SIZE + EXTENDED_SIZE + 30;
        if (has_room) {
            memcpy(message + HEADER_SIZE, sizes, EXTENDED_SIZE);
            memcpy(message + size - 30, block, 30);
            message[MESSAGE_ID_AT] ^= 1; /* the message id may differ */
        }
        CHECK(has_metadata(&known, message, size) == has_room && has_metadata(&none, message, size));
        if (has_room) {
            message[size - 1] ^= 1;
            CHECK(!has_metadata(&known, message, size));
        }
        free(message);
    }
    free(sizes), free(block);
}

/* With and without AVX2, the loops give the same bytes. */
static void test_both_loops(void)
{
    for (ssize_t count = 1; count < 200; count++) {
        uint8_t *from = bytes_of(POINT_BYTES * count), *one = bytes_of(ROW_OF_POINTS * count), *other = bytes_of(ROW_OF_POINTS * count);
        for (ssize_t i = 0; i < POINT_BYTES * count; i += 4)
            put_u32(from + i, word_of((float)(int32_t)any() / 1024.0f));
        begin_bulk(0);
        uint32_t odd = put_points(one, from, count, 1.0f, 1000.0f, 0);
        begin_bulk(1);
        CHECK(put_points(other, from, count, 1.0f, 1000.0f, 0) == odd && !odd);
        CHECK(!memcmp(one, other, (size_t)(ROW_OF_POINTS * count)));
        uint8_t *there = bytes_of(POINT_BYTES * count), *too = bytes_of(POINT_BYTES * count);
        const struct points points = {one, ROW_OF_POINTS, 0, 4, 8, 1000.0f, 1.0f};
        begin_bulk(0);
        CHECK(!points_to_igtl(&points, 0, count, there));
        begin_bulk(1);
        CHECK(!points_to_igtl(&points, 0, count, too));
        CHECK(!memcmp(there, too, (size_t)(POINT_BYTES * count)));
        free(from), free(one), free(other), free(there), free(too);
    }
}

/* -- foreign bytes ------------------------------------------------------------------------------------------------------- */

/* A count that is small, near a limit, or any. */
static uint32_t foreign_count(ssize_t size)
{
    switch (below(4)) {
    case 0: return below(8);
    case 1: return (uint32_t)(size / (ssize_t)(4 + below(24)));
    case 2: return UINT32_MAX - below(3);
    default: return any();
    }
}

static void foreign_igtl(void)
{
    static const int forms[] = {TEXT, POINT, POINTS, CLOUD, MESH, TRIANGLES};
    ssize_t content = (ssize_t)below(3) ? (ssize_t)below(600) : POINT_BYTES * (ssize_t)below(6), size = HEAD + content;
    uint8_t *data = bytes_of(size), *template = bytes_of(200);
    data[1] = 1; /* a version 2 would have an extended header before the content */
    put_u64(data + BODY_SIZE_AT, (uint64_t)content);
    if (below(4) && content >= POLYDATA_HEAD) { /* counts of POLYDATA that fit, or nearly */
        memset(data + HEAD, 0, POLYDATA_HEAD);
        ssize_t points = 1 + (ssize_t)below(20), cells = (content - POLYDATA_HEAD - 12 * points) / CELL_BYTES;
        put_u32(data + HEAD, below(5) ? (uint32_t)points : foreign_count(content));
        put_u32(data + HEAD + 20, below(5) ? (uint32_t)cells : foreign_count(content));
        put_u32(data + HEAD + 24, (uint32_t)(CELL_BYTES * cells));
        for (ssize_t at = HEAD + POLYDATA_HEAD + 12 * points; at + 16 <= size; at += CELL_BYTES) {
            put_u32(data + at, 3);
            for (int corner = 1; corner < 4; corner++)
                put_u32(data + at + 4 * corner, below((uint32_t)points + (below(9) ? 0 : 1)));
        }
    } else if (below(2) && content >= 4) {
        put_u32(data + HEAD, (uint32_t)MIB_ASCII << 16 | (uint32_t)(content - 4));
    }
    put_u64(data + CRC_AT, crc64(data + HEADER_SIZE, content));
    struct ros_form form = {.form = forms[below(6)], .template = template, .room = 200, .stamp_at = 4, .width_at = 60};
    if (form.form == TEXT || form.form == MESH)
        form.room = 0;
    if (form.form == TRIANGLES)
        form.rest = 40;
    uint8_t *out = has_room(&form) || !form.room ? to_ros(&form, data, size) : NULL;
    free(out), free(data), free(template);
}

static void foreign_ros(void)
{
    static const int forms[] = {TEXT, POINTS, CLOUD, MESH, TRIANGLES, PICTURE, BLUE_FIRST};
    ssize_t size = 4 + (ssize_t)below(700), least = 4 + (ssize_t)below((uint32_t)size), made = 0;
    uint8_t *cdr = bytes_of(size), *sample = bytes_of(least);
    memcpy(cdr, sample, 4);
    struct ros_bulk stream = {.sample = sample, .size = least, .form = forms[below(7)], .times = 1, .by = 1};
    ssize_t numbers[8] = {12 + (ssize_t)below(40), 28 + (ssize_t)below(300), 12 + (ssize_t)below(20), 0, 4, 8, 0, 0};
    if (stream.form == TRIANGLES)
        numbers[3] = 4 + (ssize_t)below(16), numbers[2] = 12 + numbers[3];
    if (stream.form >= PICTURE && stream.form != TRIANGLES && stream.form != MESH)
        numbers[2] = 12 + 3 * (ssize_t)below(200);
    if (stream.form != TEXT && stream.form != MESH && !set_places(&stream, numbers, 8))
        stream.form = below(2) ? TEXT : MESH;
    ssize_t words = size / 4 - 1; /* some of them are counts */
    for (uint32_t i = below(6); i && words > 1; i--)
        put_u32_ros(cdr + 4 + 4 * (ssize_t)below((uint32_t)words), foreign_count(size));
    if (stream.form == MESH && below(3)) {
        free(cdr);
        cdr = mesh_of(1 + (ssize_t)below(9), 1 + (ssize_t)below(9), &size);
        put_u32_ros(cdr + (below(2) ? 4 : 8 + 12 * (ssize_t)get_u32_ros(cdr + 4)), foreign_count(size));
        memcpy(sample, cdr, 4);
    }
    free(to_igtl(&stream, cdr, size, &made));
    free(cdr), free(sample);
}

/* Rows of numbers within a message and its content, or nearly. */
static void foreign_numbers(void)
{
    ssize_t size = 12 + (ssize_t)below(200), content = 1 + (ssize_t)below(100), rows = 1 + (ssize_t)below(5), made = 0;
    ssize_t all = size + content + ROW_OF_NUMBERS * rows;
    uint8_t *sample = bytes_of(all), *cdr = bytes_of(size);
    for (ssize_t i = 0; i < rows; i++) {
        uint8_t *row = sample + size + content + ROW_OF_NUMBERS * i;
        uint32_t begin = below((uint32_t)size + 2), to = below(2) * below((uint32_t)content + 2);
        put_u32_ros(row, begin);
        put_u32_ros(row + 4, below(9) ? begin + (to ? 8 * below(4) : 0) : foreign_count(size));
        put_u32_ros(row + 8, to);
    }
    struct ros_bulk stream = {.sample = sample, .size = all, .form = NUMBERS, .times = 1, .by = 1};
    const ssize_t numbers[6] = {rows, size, content, 0, 0, 0};
    memcpy(cdr, sample, (size_t)size);
    if (set_places(&stream, numbers, 6))
        free(to_igtl(&stream, cdr, size - (ssize_t)below(2), &made));
    free(cdr), free(sample);
}

/* -- the recorder's queue -------------------------------------------------------------------------------------------------- */

static void test_queue(void)
{
    const uint64_t room = 3000;
    uint64_t *memory = calloc(1, QUEUE_PAGE + room);
    if (!memory)
        exit(2);
    struct queue queue = queue_open(memory);
    queue.counters[QUEUE_LIMIT] = room;
    queue.counters[QUEUE_MAX_ENTRIES] = 1000, queue.counters[QUEUE_MAX_BYTES] = 1 << 20;
    uint8_t payload[300];
    memset(payload, 'p', sizeof payload);
    uint64_t put = 0, place = 0;
    while (queue_put(&queue, 1, 10 + put, 20, 30, payload, 100 + 10 * put))
        put++;
    CHECK(put > 5 && queue.counters[QUEUE_ENTRIES] == put && queue.counters[QUEUE_PLACE] <= room);
    for (uint64_t i = 0; i < put; i++) {
        uint64_t head[5];
        memcpy(head, queue.room + place, sizeof head);
        CHECK(head[0] == 1 && head[1] == 100 + 10 * i && head[2] == 10 + i && head[3] == 20 && head[4] == 30);
        place += queue_need(head[1]);
    }
    CHECK(place == queue.counters[QUEUE_HEAD]);
    queue.counters[QUEUE_PLACE] = 0; /* the reader has freed all */
    uint8_t *slot = queue_reserve(&queue, 2, 1, 2, 3, 50);
    uint64_t what;
    memcpy(&what, slot - QUEUE_RECORD_BYTES, sizeof what);
    CHECK(what == (2 | QUEUE_FILLING));
    memset(slot, 'q', 50);
    queue_filled(slot);
    memcpy(&what, slot - QUEUE_RECORD_BYTES, sizeof what);
    CHECK(what == 2);
    CHECK(!queue_knows(&queue, (uint64_t)1 << 32)); /* of an earlier generation */
    queue.counters[QUEUE_CLOSED] = 1;
    CHECK(!queue_put(&queue, 1, 1, 1, 1, payload, 1));
    free(memory);
}

/* -- records of MCAP --------------------------------------------------------------------------------------------------- */

static void put_record(uint8_t *at, uint8_t opcode, uint64_t length)
{
    at[0] = opcode;
    memcpy(at + 1, &length, 8);
}

static void test_records(void)
{
    enum { SIZE = 12 + 31 + 34 };
    uint8_t *data = bytes_of(SIZE);
    const uint64_t times[] = {9, 4};
    const uint16_t channel = 513;
    put_record(data, 3, 3);
    for (int i = 0; i < 2; i++) {
        uint8_t *record = data + 12 + 31 * i;
        put_record(record, MESSAGE, (uint64_t)(MESSAGE_HEAD + 3 * i));
        memcpy(record + RECORD_HEAD, &channel, 2);
        memcpy(record + RECORD_HEAD + TIME_AT, &times[i], 8);
        memcpy(record + RECORD_HEAD + PUBLISH_AT, &times[i], 8);
    }
    struct messages_found found = count_messages(data, SIZE);
    CHECK(found.count == 2 && found.end == SIZE && !found.in_order && found.late == (9 | 4));
    uint16_t channels[2];
    uint32_t sequences[2];
    uint64_t stamps[2], published[2];
    int64_t begins[2], ends[2];
    const struct message_columns rows = {channels, sequences, stamps, published, begins, ends};
    size_t at = 0;
    CHECK(take_messages(data, SIZE, &at, 1, &rows) == 1 && at == 43);
    CHECK(channels[0] == 513 && stamps[0] == 9 && begins[0] == 43 && ends[0] == 43);
    CHECK(take_messages(data, SIZE, &at, 2, &rows) == 1 && at == SIZE && begins[0] == 74 && ends[0] == SIZE);
    for (size_t size = 0; size < SIZE; size++) { /* cut off anywhere */
        uint8_t *cut = bytes_of((ssize_t)size);
        memcpy(cut, data, size);
        found = count_messages(cut, size);
        CHECK(found.end == (size < 12 ? 0u : size < 43 ? 12u : 43u) && found.count == (size >= 43));
        free(cut);
    }
    put_record(data + 12, MESSAGE, MESSAGE_HEAD - 1); /* a message without all of its fields */
    CHECK(count_messages(data, SIZE).end == 12);
    put_record(data, 3, UINT64_MAX); /* a length that would wrap around */
    CHECK(count_messages(data, SIZE).end == 0);
    free(data);
}

static void foreign_records(void)
{
    ssize_t size = (ssize_t)below(400);
    uint8_t *data = bytes_of(size);
    for (ssize_t at = 0; at + RECORD_HEAD <= size; at += RECORD_HEAD + (ssize_t)below(60))
        put_record(data + at, below(3) ? MESSAGE : (uint8_t)any(), below(9) ? below(60) : any());
    struct messages_found found = count_messages(data, (size_t)size);
    uint16_t channels[16];
    uint32_t sequences[16];
    uint64_t stamps[16], published[16];
    int64_t begins[16], ends[16];
    const struct message_columns rows = {channels, sequences, stamps, published, begins, ends};
    size_t at = 0, taken = take_messages(data, (size_t)size, &at, 16, &rows);
    CHECK(taken == (found.count < 16 ? found.count : 16) && (taken == 16 || at == found.end));
    for (size_t i = 0; i < taken; i++)
        CHECK(begins[i] <= ends[i] && ends[i] <= size);
    free(data);
}

/* A RawMessage with the head ``same``, whose payload has ``size`` bytes. */
static uint8_t *raw_message(const uint8_t *same, size_t same_size, uint32_t size)
{
    uint8_t *raw = bytes_of((ssize_t)(RAW_HEAD + same_size + 4 + size));
    raw[0] = 0, raw[1] = 1;
    memcpy(raw + RAW_HEAD, same, same_size);
    memcpy(raw + RAW_HEAD + same_size, &size, 4);
    return raw;
}

static void test_raw_messages(void)
{
    const uint8_t *bytes = (const uint8_t *)"aaaabbbbbbbbcccc";
    const int64_t offsets[] = {0, 4, 12, 16};
    const int32_t next[] = {1, 0, 2};
    int32_t *last = malloc(sizeof *last * 65536), head = -1;
    if (!last)
        exit(2);
    for (int i = 0; i < 65536; i++)
        last[i] = -1;
    last[7] = 0, last[9] = 2;
    const struct raw_heads heads = {bytes, offsets, next, last, 3};
    for (uint32_t size = 0; size < 70; size++) {
        uint8_t *raw = raw_message(bytes + 4, 8, size);
        const size_t whole = RAW_HEAD + 8 + 4 + size;
        CHECK(raw_place(raw, whole, 7, &heads, &head) == RAW_HEAD + 12 && head == 1 && last[7] == 1);
        CHECK(raw_place(raw, whole, 9, &heads, &head) == 0 && last[9] == 2); /* of another channel */
        CHECK(raw_place(raw, whole, 8, &heads, &head) == 0);
        memset(raw + RAW_SOURCE_AT, 0, 8);
        raw[RAW_DIRECTION_AT] = 3;
        CHECK(raw_flags(raw) == RAW_OUTGOING);
        raw[RAW_DIRECTION_AT] = 0, raw[RAW_SOURCE_AT + 7] = 1;
        CHECK(raw_flags(raw) == RAW_STAMPED);
        raw[1] = 0; /* big-endian */
        CHECK(raw_place(raw, whole, 7, &heads, &head) == 0);
        raw[1] = 1;
        for (size_t cut = 0; cut < whole; cut++) {
            uint8_t *part = bytes_of((ssize_t)cut);
            memcpy(part, raw, cut);
            CHECK(raw_place(part, cut, 7, &heads, &head) == 0);
            free(part);
        }
        free(raw);
    }
    free(last);
}

int main(int count, char **words)
{
    long rounds = count > 1 ? strtol(words[1], NULL, 10) : 20000;
    random_state = count > 2 ? strtoull(words[2], NULL, 10) | 1 : 1;
    begin_bytes();
    for (int allowed = 0; allowed < 2; allowed++) {
        begin_bulk(allowed);
        test_crc();
        test_stamps();
        test_poses();
        test_meshes();
        test_pictures();
        test_texts();
        test_markers();
        test_clouds();
        test_pose_streams();
        test_tools();
        test_metadata();
        test_queue();
        test_records();
        test_raw_messages();
        for (long i = 0; i < rounds; i++) {
            foreign_igtl();
            foreign_ros();
            foreign_numbers();
            foreign_records();
        }
    }
    test_both_loops();
    printf("kernel: %ld rounds, seed %" PRIu64 ", %d failures\n", rounds, random_state, failures);
    return failures != 0;
}
