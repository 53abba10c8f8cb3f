// A service that is busy for a known time, on rcl as rclcpp uses it: rcl_wait, rcl_take_request, rcl_send_response.
//
// busy service BUSY_S TRUTH     TRUTH gets one line of JSON a request: {"busy_s": 0.02}
#include <rcl/error_handling.h>
#include <rcl/rcl.h>
#include <signal.h>
#include <std_srvs/srv/trigger.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

// Python's halves of the wheels' messages are loaded too, and look for these; nobody here uses them.
void *PyExc_RuntimeError, *_Py_TrueStruct;

static volatile sig_atomic_t ended;
static void end(int number) { ended = number; }

static double now_s(void) {
  struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return t.tv_sec + t.tv_nsec / 1e9;
}

static void need(rcl_ret_t code, const char *what) {
  if (code == RCL_RET_OK) return;
  fprintf(stderr, "%s: %s\n", what, rcl_get_error_string().str);
  exit(1);
}

static void answer(rcl_service_t *service, double busy_s, FILE *truth) {
  std_srvs__srv__Trigger_Request request;
  std_srvs__srv__Trigger_Response response;
  std_srvs__srv__Trigger_Request__init(&request);
  std_srvs__srv__Trigger_Response__init(&response);
  rmw_request_id_t id;
  if (rcl_take_request(service, &id, &request) == RCL_RET_OK) {
    double begun_s = now_s();
    const struct timespec pause = {(time_t)busy_s, (long)((busy_s - (time_t)busy_s) * 1e9)};
    nanosleep(&pause, NULL);
    fprintf(truth, "{\"busy_s\": %.9f}\n", now_s() - begun_s);
    fflush(truth);
    response.success = true;
    need(rcl_send_response(service, &id, &response), "rcl_send_response");
  }
  std_srvs__srv__Trigger_Request__fini(&request);
  std_srvs__srv__Trigger_Response__fini(&response);
}

int main(int argc, char **argv) {
  if (argc < 4) return 2;
  FILE *truth = fopen(argv[3], "a");
  if (!truth) return 1;
  signal(SIGINT, end);
  signal(SIGTERM, end);
  rcl_allocator_t allocator = rcl_get_default_allocator();
  rcl_init_options_t options = rcl_get_zero_initialized_init_options();
  need(rcl_init_options_init(&options, allocator), "rcl_init_options_init");
  rcl_context_t context = rcl_get_zero_initialized_context();
  need(rcl_init(1, (const char *const *)argv, &options, &context), "rcl_init");
  rcl_node_t node = rcl_get_zero_initialized_node();
  rcl_node_options_t plain = rcl_node_get_default_options();
  need(rcl_node_init(&node, "busy", "", &context, &plain), "rcl_node_init");
  rcl_service_t service = rcl_get_zero_initialized_service();
  rcl_service_options_t kept = rcl_service_get_default_options();
  const rosidl_service_type_support_t *type = ROSIDL_GET_SRV_TYPE_SUPPORT(std_srvs, srv, Trigger);
  need(rcl_service_init(&service, &node, type, "plan", &kept), "rcl_service_init");
  rcl_wait_set_t set = rcl_get_zero_initialized_wait_set();
  need(rcl_wait_set_init(&set, 0, 0, 0, 0, 1, 0, &context, allocator), "rcl_wait_set_init");
  while (!ended) {
    need(rcl_wait_set_clear(&set), "rcl_wait_set_clear");
    need(rcl_wait_set_add_service(&set, &service, NULL), "rcl_wait_set_add_service");
    if (rcl_wait(&set, RCL_MS_TO_NS(200)) == RCL_RET_OK && set.services[0]) answer(&service, atof(argv[2]), truth);
  }
  return fclose(truth);
}
