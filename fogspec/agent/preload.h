// Pending requests and the records that are written about them. See preload.c.
//
// A request arrives when the middleware received it (received_timestamp, where the middleware gives one), is taken when the
// node asks for it, and departs when its response was handed over. Response time is departure - arrival; service time is
// departure - max(taken, this thread's previous departure): an executor that is busy takes late, and a worker thread that is
// handed requests works on one at a time.
#define _GNU_SOURCE
#include <fcntl.h>
#include <pthread.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#define PENDING 1024
#define RECENT 64
#define KEY 24            // the longest key: an rmw_request_id_t, which is writer_guid[16] and a sequence number
#define JUMP_NS 20000000  // the two clocks drift apart by less between two requests

typedef struct { bool used; uint8_t key[KEY]; uint64_t order; int64_t arrival_ns, taken_ns; } request_t;

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static request_t pending[PENDING];
static uint64_t taken_count, answered_count;
// The latest stamps that were taken, each with the subscription that did.
static struct { const void *by; uint8_t key[KEY]; } recent[RECENT];
static int64_t clock_offset_ns;
static _Thread_local int64_t departed_ns;

static const char *setting(const char *variable) {
  const char *value = getenv(variable);
  return value && *value ? value : NULL;
}

static int64_t now_ns(clockid_t clock) {
  struct timespec t;
  clock_gettime(clock, &t);
  return t.tv_sec * 1000000000LL + t.tv_nsec;
}

// ---- records ---------------------------------------------------------------------------------------------------------

// Reopened each time: the file is moved when it is large, and nothing is shared with forked processes.
static void append(const char *text, int length) {
  const char *path = setting("FOGSPEC_TIMINGS");
  int file = path ? open(path, O_WRONLY | O_APPEND | O_CREAT | O_CLOEXEC, 0644) : -1;
  if (file >= 0 && length > 0 && write(file, text, (size_t)length) != length)
    fprintf(stderr, "fogspec: a timing could not be written\n");
  if (file >= 0) close(file);
}

static void write_request(const char *name, const request_t *one, int64_t end_ns, int64_t service_ns, const char *failure) {
  char line[512], why[96] = "null", stamp[64] = "";
  if (failure) snprintf(why, sizeof why, "\"%s\"", failure);
  if (setting("FOGSPEC_STAMPED"))
    snprintf(stamp, sizeof stamp, ",\"stamp\":[%d,%u]", *(const int32_t *)one->key, *(const uint32_t *)(one->key + 4));
  append(line, snprintf(line, sizeof line,
    "{\"name\":\"%.200s\",\"start_s\":%.9f,\"latency_s\":%.9f,\"service_s\":%.9f,\"ok\":%s,\"metrics\":{},\"reason\":%s%s}\n",
    name, one->arrival_ns / 1e9, (end_ns - one->arrival_ns) / 1e9, service_ns / 1e9, failure ? "false" : "true", why, stamp));
}

static void write_lost(const char *name, const request_t *one) {
  char line[384];
  append(line, snprintf(line, sizeof line,
    "{\"name\":\"%.200s\",\"start_s\":%.9f,\"latency_s\":0,\"ok\":false,\"lost\":true,\"metrics\":{},\"reason\":\"no response\"}\n",
    name, one->arrival_ns / 1e9));
}

// Which of the requests with one stamp a response answers is not known (fogspec/agent/matching.py).
static void write_repeated(const char *name, const uint8_t *key, int64_t taken_ns) {
  char line[448];
  append(line, snprintf(line, sizeof line,
    "{\"name\":\"%.200s\",\"start_s\":%.9f,\"latency_s\":0,\"ok\":false,\"lost\":true,\"metrics\":{},\"reason\":"
    "\"its stamp %d.%09u is that of an earlier request: give each its own, or match by order\"}\n",
    name, taken_ns / 1e9, *(const int32_t *)key, *(const uint32_t *)(key + 4)));
}

static void write_unmatched(const char *name) {
  char line[320];
  append(line, snprintf(line, sizeof line, "{\"name\":\"%.200s\",\"unmatched\":true,\"at_s\":%.9f}\n", name,
    now_ns(CLOCK_MONOTONIC) / 1e9));
}

// A hint why nothing is timed: the last note becomes part of the sample's outcome.
static void write_unanswered(const char *name) {
  char line[320];
  append(line, snprintf(line, sizeof line, "{\"note\":\"requests are taken, and none is answered on %.200s\"}\n", name));
}

// Another name than the configured one: reported once each, until a request of the configured name arrives.
static void write_other(const char *name) {
  static char seen[8][128];
  static int count;
  if (!name || strlen(name) >= sizeof seen[0]) return;
  pthread_mutex_lock(&lock);
  bool known = count >= 8 || taken_count > 0;
  for (int i = 0; i < count; i++) known = known || strcmp(seen[i], name) == 0;
  if (!known) {
    char line[320];
    strcpy(seen[count++], name);
    append(line, snprintf(line, sizeof line, "{\"note\":\"the measured process also takes %s\"}\n", name));
  }
  pthread_mutex_unlock(&lock);
}

// ---- arrivals and departures -----------------------------------------------------------------------------------------

// The middleware stamps arrivals with the wall clock, which may be set while a request waits: then its arrival is unknown,
// and it counts from when it was taken.
static int64_t arrival(int64_t taken_ns, int64_t received_ns) {
  int64_t offset_ns = now_ns(CLOCK_REALTIME) - now_ns(CLOCK_MONOTONIC), jump_ns = offset_ns - clock_offset_ns;
  bool steady = clock_offset_ns == 0 || (jump_ns < JUMP_NS && jump_ns > -JUMP_NS);
  clock_offset_ns = offset_ns;
  int64_t arrived_ns = received_ns - offset_ns;
  return received_ns > 0 && steady && arrived_ns > 0 && arrived_ns < taken_ns ? arrived_ns : taken_ns;
}

static request_t *find(const uint8_t *key) {
  request_t *found = NULL;
  for (int i = 0; i < PENDING; i++)
    if (pending[i].used && (key ? memcmp(pending[i].key, key, KEY) == 0 : !found || pending[i].order < found->order)) {
      found = &pending[i];
      if (key) break;
    }
  return found;
}

// Return which subscription took a message with this stamp lately, and remember it: NULL for none.
static const void *taken_by(const void *by, const uint8_t *key) {
  static unsigned next;
  for (int i = 0; i < RECENT; i++)
    if (recent[i].by && memcmp(recent[i].key, key, KEY) == 0) return recent[i].by;
  recent[next].by = by;
  memcpy(recent[next].key, key, KEY);
  next = (next + 1) % RECENT;
  return NULL;
}

// `by` is the subscription of a message with a stamp, NULL for others: their keys are unique.
static void take(const char *name, const void *by, const uint8_t *key, int64_t taken_ns, int64_t received_ns) {
  pthread_mutex_lock(&lock);
  if (taken_count == 0) write_unanswered(name);
  const void *before = by && key ? taken_by(by, key) : NULL;
  if (before && before == by && answered_count) write_repeated(name, key, taken_ns);
  // A second subscription of the same node takes the same message.
  if (!before && (!key || !find(key))) {
    request_t *slot = NULL;
    for (int i = 0; i < PENDING && !slot; i++)
      if (!pending[i].used) slot = &pending[i];
    if (!slot) {
      slot = find(NULL);
      write_lost(name, slot);
    }
    *slot = (request_t){.used = true, .order = taken_count++, .arrival_ns = arrival(taken_ns, received_ns), .taken_ns = taken_ns};
    if (key) memcpy(slot->key, key, KEY);
  }
  pthread_mutex_unlock(&lock);
}

// `key` NULL: the oldest open request, whatever it is.
static void depart(const char *name, const uint8_t *key, const char *failure) {
  int64_t end_ns = now_ns(CLOCK_MONOTONIC);
  pthread_mutex_lock(&lock);
  request_t *one = find(key);
  if (one) {
    int64_t begin_ns = one->taken_ns > departed_ns ? one->taken_ns : departed_ns;
    one->used = false;
    answered_count++;
    write_request(name, one, end_ns, end_ns - begin_ns, failure);
  } else {
    write_unmatched(name);
  }
  pthread_mutex_unlock(&lock);
  departed_ns = end_ns;
}

static void key_of(uint8_t *key, const void *bytes, size_t length) {
  memset(key, 0, KEY);
  memcpy(key, bytes, length);
}
